"""How much processor time other processes have used, to tell one that works from one that waits.

A busy machine gives a process less of its processors, not less to do: what bounds work is the time
that the work itself has used. Linux tells it; elsewhere the functions return None.
"""

from __future__ import annotations

import os


def of_process(pid: int) -> float | None:
    """What a process has used so far, with the children that it has seen end [s]."""
    words = _words(str(pid))
    return _seconds(words) if words else None


def of_session(session: int) -> float | None:
    """What the processes of a session have used so far [s].

    Args:
        session: its number, which is the process id of its first process.
    """
    try:
        names = [name for name in os.listdir("/proc") if name.isdigit()]
    except OSError:
        return None
    found = [words for words in map(_words, names) if words and int(words[3]) == session]
    return sum(map(_seconds, found)) if found else None


def _words(pid: str) -> list[str]:
    """The words of a process's line after its name; none of one that has ended meanwhile."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()
    except OSError:
        return []


def _seconds(words: list[str]) -> float:
    return sum(int(word) for word in words[11:15]) / os.sysconf("SC_CLK_TCK")
