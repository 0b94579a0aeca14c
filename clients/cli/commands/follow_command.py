"""`flexdt follow`: a real scanner's messages beside the twin's prediction."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flexdt import machines
from flexdt.clients.cli import options
from flexdt.clients.cli.boundary import INVALID, REFUSED, USAGE
from flexdt.clients.cli.console import note, say
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.clients.failure import CommandError

if TYPE_CHECKING:
    from flexdt.clients.following.session import FollowSession, FramesBeside
    from flexdt.twin.following.follower import Follower
    from flexdt.twin.following.mirror import Alarm

STATUS_S = 5.0


def follow(
    address: str | None = argument(None, "ADDRESS", "tcp://HOST[:PORT] of its outgoing events."),
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    script: Path | None = option(
        None, "Predict this script, which the scanner will run.", metavar="FILE"
    ),
    sample: str | None = option(None, "Put this phantom on the stage.", metavar="NAME or FILE"),
    record: Path | None = option(
        None, "Record the raw messages, for --replay and flexdt machine fit.", metavar="FILE"
    ),
    replay: Path | None = option(None, "Hear this recording instead of a scanner.", metavar="FILE"),
    frames: Path | None = option(
        None, "Compare the images that appear here; needs --sample.", metavar="DIR"
    ),
    out: Path = option(Path(), "Write beside.png and beside.json of --frames here.", metavar="DIR"),
    port: int | None = option(
        None,
        "Show the machine to clients on this port, as a twin without control.",
        metavar="PORT",
        min=0,
        max=65535,
    ),
    seconds: float | None = option(None, "End after this time.", "--for", metavar="S", min=0.0),
    json: bool = False,
) -> Answer:
    """Follow a real scanner: hear its messages, compare, and say what leaves the prediction.

    Nothing is ever sent to the scanner. Ends with Ctrl-C or after --for. Exit code 4 if there was
    no connection.
    """
    from flexdt.clients.following.recording import STAMP
    from flexdt.clients.following.session import FollowSession

    if (address is None) == (replay is None):
        raise CommandError("give either ADDRESS or --replay FILE", USAGE)
    follower = _follower(machine, profile, script, sample)
    if replay is not None:
        recording = replay.read_bytes()
        if STAMP.match(recording) is None:
            raise CommandError(
                f"{replay}: no message of the form [hh:mm:ss.ffffff] {{...}}", INVALID
            )
        session = FollowSession(follower)
        session.tell = (lambda alarm: None) if json else partial(_say, session)
        session.replay(recording)
        yield from _told(session, str(replay))
        return
    beside = None
    if frames is not None:
        from flexdt.clients.following.session import FramesBeside
        from flexdt.phantoms.samples import as_phantom

        if sample is None or not frames.is_dir():
            raise CommandError("--frames needs --sample, and a folder that is there", USAGE)
        beside = (frames, FramesBeside(follower, as_phantom(sample), out))
    from flexdt.clients.extras import package

    zmq = package("zmq", "flexdt follow", "gateway")
    from flexdt.clients.following.listening import endpoint

    try:
        at = endpoint(address or "")
    except ValueError as error:
        raise CommandError(str(error), USAGE) from None
    with ExitStack() as files:
        log = None if record is None else files.enter_context(record.open("ab"))
        session = FollowSession(follower, record=log)
        session.tell = (lambda alarm: None) if json else partial(_say, session)
        note(f"following {at}, compared with machine {follower.machine.name}; Ctrl-C ends it")
        try:
            with suppress(KeyboardInterrupt):
                asyncio.run(_run(session, at, seconds, port, beside))
        except* zmq.ZMQError as group:
            why = "; ".join(map(str, group.exceptions))
            raise CommandError(f"{at}: {why}", REFUSED) from None
    yield from _told(session, at)
    if session.mirror.heard_s is None and not session.mirror.connected:
        raise CommandError(f"{at}: there has been no connection", REFUSED)


def _told(session: FollowSession, source: str) -> Answer:
    if session.unread:
        note(_unread(session))
    yield {
        "address": source,
        "unread": session.unread,
        "unread_example": session.unread_example,
        **session.mirror.to_dict(session.clock()),
    }


def _unread(session: FollowSession) -> str:
    return f"{session.unread} messages in no known form, the first: {session.unread_example}"


def _follower(
    machine: str | None, profile: str | None, script: Path | None, sample: str | None
) -> Follower:
    from flexdt.phantoms.samples import as_phantom
    from flexdt.scripts import collisions, size_of
    from flexdt.twin.following.follower import Follower
    from flexdt.twin.script import parse_script

    chosen = machines.machine(machine)
    phantom = None if sample is None else as_phantom(sample)
    return Follower(
        chosen,
        machines.profile(profile, chosen, machine),
        None if script is None else parse_script(script.read_bytes()),
        size_of(phantom),
        collisions(phantom),
    )


async def _run(
    session: FollowSession,
    address: str,
    seconds: float | None,
    port: int | None,
    beside: tuple[Path, FramesBeside] | None,
) -> None:
    if port is not None:
        from flexdt.clients.following.read_only_twin import ReadOnlyTwin

        twin = ReadOnlyTwin(session.follower, lambda: session.mirror, session.clock, address)
        server = await twin.serve("127.0.0.1", port)
        shown = server.sockets[0].getsockname()[1]
        note(f"shown to clients: flexdt viewer --twin 127.0.0.1:{shown}")
    work = asyncio.create_task(session.run(address))
    more = [asyncio.create_task(_status(session))]
    if beside is not None:
        more.append(asyncio.create_task(session.show_frames(*beside)))
    await asyncio.wait({work}, timeout=seconds)
    for task in (work, *more):
        task.cancel()
    await asyncio.gather(work, *more, return_exceptions=True)
    if not work.cancelled() and (error := work.exception()) is not None:
        raise error


async def _status(session: FollowSession) -> None:
    """Say now and then how old what is known is."""
    while True:
        await asyncio.sleep(STATUS_S)
        mirror = session.mirror
        age = mirror.age_s(session.clock())
        link = "connected" if mirror.connected else "NOT CONNECTED"
        old = "nothing heard yet" if age is None else f"last message {age:.1f} s ago"
        under_way = ", ".join(w.heard.text for w in mirror.waiting.values()) or "nothing under way"
        note(f"{link}, {old}; {under_way}; {mirror.raised} alarms")
        if session.unread:
            note(_unread(session))


def _say(session: FollowSession, alarm: Alarm) -> None:
    at = session.time_of_day(alarm.at_s)[:8]
    say(f"{at} {alarm.severity} {alarm.kind} ({alarm.about}): {alarm.message}")
