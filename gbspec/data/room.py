"""How much memory is free: a process that takes more is ended by the system, without a word."""

from __future__ import annotations

from pathlib import Path

MEMORY, GROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def free_memory() -> int | None:
    """The bytes that this process may still take; None where the system does not tell (then nothing is refused)."""
    found = [size for size in (_of_machine(MEMORY), _of_group(GROUP)) if size is not None]
    return min(found, default=None)


def _of_machine(path: Path) -> int | None:
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)
    except (OSError, ValueError, IndexError):
        return None


def _of_group(folder: Path) -> int | None:
    """What a container or a batch system leaves, whose limit is below that of the machine."""
    try:
        most, taken = ((folder / name).read_text(encoding="ascii").strip() for name in ("memory.max", "memory.current"))
        use = dict(line.split() for line in (folder / "memory.stat").read_text(encoding="ascii").splitlines())
        # pages of files are given back when memory is needed
        return max(int(most) - int(taken) + int(use.get("inactive_file", 0)), 0)
    except (OSError, ValueError):
        return None
