"""`flexdt follow`: compare a real scanner's messages with the twin's prediction."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flexdt.clients.cli import options, value_completion
from flexdt.clients.cli.boundary import INVALID, REFUSED, USAGE
from flexdt.clients.cli.console import note, say
from flexdt.clients.cli.options import Answer, argument, option
from flexdt.library import machines
from flexdt.library.failure import CommandError
from flexdt.runtime.files.limited_files import limited_bytes

if TYPE_CHECKING:
    from flexdt.clients.following.frames_beside import FramesBeside
    from flexdt.clients.following.session import FollowSession
    from flexdt.twin.following.follower import Follower
    from flexdt.twin.following.mirror import Alarm

STATUS_S = 5.0


def follow(
    address: str | None = argument(None, "ADDRESS"),
    machine: options.MachineName = None,
    profile: options.ProfileName = None,
    script: Path | None = option(None, metavar="FILE"),
    sample: str | None = option(
        None, metavar="NAME or FILE", proposes=value_completion.sample_names
    ),
    record: Path | None = option(None, metavar="FILE", written=True),
    replay: Path | None = option(None, metavar="FILE"),
    frames: Path | None = option(None, metavar="DIR"),
    out: Path = option(Path(), metavar="DIR"),
    seconds: float | None = option(None, "--for", metavar="S", min=0.0),
    json: bool = False,
) -> Answer:
    """Follow a real scanner: compare its messages with predictions and report deviations.

    Nothing is ever sent to the scanner. Ends with Ctrl-C or after --for. Exit code 4 if there
    was no connection.

    Args:
        address: tcp://HOST[:PORT] of its outgoing events.
        script: Predict this script, which will run.
        sample: Put this phantom on the stage.
        record: Append the raw messages to this file.
        replay: Hear this recording instead of a scanner.
        frames: Compare images that appear here.
        out: Write beside.png and beside.json of --frames here.
        seconds: End after this time.

    Yields:
        The state of the mirror at the end as document of --json. Alarms are printed as
        they come, without --json; counts of alarms and unread messages at the end go to
        standard error. Exactly one of address and --replay, else a usage error.
    """
    import asyncio

    from flexdt.clients.following.frames_beside import FramesBeside
    from flexdt.clients.following.recording import STAMP
    from flexdt.clients.following.session import FollowSession

    if (address is None) == (replay is None):
        raise CommandError("give either ADDRESS or --replay FILE", USAGE)
    follower = _follower(machine, profile, script, sample)
    session = FollowSession(follower)
    if json:
        session.tell = lambda alarm: None
    else:
        session.tell = partial(_say, session)
    if replay is not None:
        recording = limited_bytes(replay, "log")
        if STAMP.match(recording) is None:
            raise CommandError(f"{replay}: no message [hh:mm:ss] {{...}}", INVALID)
        session.replay(recording)
        yield from _session_lines(session, str(replay))
        return
    beside = None
    if frames is not None:
        from flexdt.phantoms.samples import as_phantom

        if sample is None or not frames.is_dir():
            raise CommandError(
                "--frames needs --sample, and a folder that is there", USAGE
            )
        beside = (frames, FramesBeside(follower, as_phantom(sample), out))
    from flexdt.library.optional.extras import package

    zmq = package("zmq", "flexdt follow", "gateway")
    from flexdt.clients.following.listening import endpoint

    try:
        at = endpoint(address or "")
    except ValueError as error:
        raise CommandError(str(error), USAGE) from None
    with ExitStack() as files:
        if record is None:
            session.record = None
        else:
            session.record = files.enter_context(record.open("ab"))
        note(
            f"following {at}, compared with machine {follower.machine.name}; Ctrl-C ends it"
        )
        try:
            with suppress(KeyboardInterrupt):
                asyncio.run(_run(session, at, seconds, beside))
        except* zmq.ZMQError as group:
            why = "; ".join(map(str, group.exceptions))
            raise CommandError(f"{at}: {why}", REFUSED) from None
    yield from _session_lines(session, at)
    if session.mirror.heard_s is None and not session.mirror.connected:
        raise CommandError(f"{at}: there has been no connection", REFUSED)


def _session_lines(session: FollowSession, source: str) -> Answer:
    """Note how many alarms were raised, and yield the mirror as document of --json."""
    note(f"{session.mirror.raised} alarms{_unread(session)}")
    unread = {"unread": session.unread, "unread_example": session.unread_example}
    yield {"address": source, **unread, **session.mirror.to_dict(session.clock())}


def _unread(session: FollowSession) -> str:
    found = f"; {session.unread} messages in no known form, the first: {session.unread_example}"
    return found if session.unread else ""


def _follower(
    machine: str | None, profile: str | None, script: Path | None, sample: str | None
) -> Follower:
    """Build the follower of a machine, with its profile, script and sample.

    Sizes and collisions are those of the sample's phantom, or of an empty stage.

    Args:
        machine: name or file; None for the default.
        profile: name or file of the zero offsets; None for the machine's own.
        script: file of the script that will run; None for none.
        sample: phantom on the stage; None for none.
    """
    from flexdt.library.scripts import collisions, size_of
    from flexdt.phantoms.samples import as_phantom
    from flexdt.twin.following.follower import Follower
    from flexdt.twin.script import parse_script

    chosen = machines.machine(machine)
    if sample is None:
        phantom = None
    else:
        phantom = as_phantom(sample)
    return Follower(
        chosen,
        machines.profile(profile, chosen, machine),
        None if script is None else parse_script(limited_bytes(script, "script")),
        size_of(phantom),
        collisions(phantom),
    )


async def _run(
    session: FollowSession,
    address: str,
    seconds: float | None,
    beside: tuple[Path, FramesBeside] | None,
) -> None:
    """Follow the scanner for some seconds (None: without end), or until it ends, with a
    status line and images from `beside`; raises the session's error, if it has one.

    After the time all tasks are canceled, without an error. Errors of the status line
    and of images are dropped.
    """
    import asyncio

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
    """Print every `STATUS_S` seconds, until canceled: connection, age of the last
    message, commands under way, number of alarms, and unread messages.

    It goes to standard error.
    """
    import asyncio

    while True:
        await asyncio.sleep(STATUS_S)
        mirror = session.mirror
        age = mirror.age_s(session.clock())
        if mirror.connected:
            link = "connected"
        else:
            link = "NOT CONNECTED"
        if age is None:
            old = "nothing heard yet"
        else:
            old = f"last message {age:.1f} s ago"
        under_way = ", ".join(mirror.under_way) or "nothing under way"
        note(f"{link}, {old}; {under_way}; {mirror.raised} alarms{_unread(session)}")


def _say(session: FollowSession, alarm: Alarm) -> None:
    at = session.time_of_day(alarm.at_s)[:8]
    say(f"{at} {alarm.severity} {alarm.kind} ({alarm.about}): {alarm.message}")
