"""What is watched while a study is made on a cluster of this machine: processes that execute runs, runs that nobody
executes, files that are opened below the scratch folder of a node, and a way to the database that can be cut."""

from __future__ import annotations

import asyncio
import ctypes
import os
import struct
import subprocess
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

NODE = b"TRAPS_NODE"  # in the environment of the processes of a node


class Proxy:
    """A way to a port of this machine that can be cut: connections break, and new ones are refused. Or it falls silent:
    connections stand, and nothing passes."""

    def __init__(self, port: int) -> None:
        self._to, self._open, self.is_cut, self.is_silent = port, set[asyncio.StreamWriter](), False, False
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        server = asyncio.run_coroutine_threadsafe(asyncio.start_server(self._serve, "127.0.0.1", 0), self._loop)
        self.port = int(server.result().sockets[0].getsockname()[1])

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.is_cut:
            writer.transport.abort()
            return
        try:
            there, onward = await asyncio.open_connection("127.0.0.1", self._to)
        except OSError:
            writer.transport.abort()
            return
        both = {writer, onward}
        self._open |= both
        await asyncio.gather(self._copy(reader, onward), self._copy(there, writer))
        self._open -= both

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while some := await reader.read(65536):
                while self.is_silent:
                    await asyncio.sleep(0.2)
                writer.write(some)
                await writer.drain()
        writer.close()

    def cut(self) -> None:
        """Break all connections and take no other."""
        self.is_cut = True
        self._loop.call_soon_threadsafe(lambda: [writer.transport.abort() for writer in self._open])

    def fall_silent(self) -> None:
        """Let nothing pass, and break nothing: what is sent arrives once it is mended."""
        self.is_silent = True

    def mend(self) -> None:
        """Take connections again, and let pass what was sent."""
        self.is_cut = self.is_silent = False


def node_of(pid: int) -> str:
    """Return the node that a process belongs to; empty where to none. Raises OSError where the process is gone."""
    parts = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    return next((part.partition(b"=")[2].decode() for part in parts if part.startswith(NODE + b"=")), "")


def executing() -> dict[int, tuple[str, str]]:
    """Return the processes that execute a run of Dagster: the run's id and the node."""
    found = dict[int, tuple[str, str]]()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError, IndexError):
                said = (entry / "cmdline").read_bytes()
                is_stopped = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0] in "TZ"
                if is_stopped or b"python" not in said[:200] or not (b"execute_run" in said or b"resume_run" in said):
                    continue
                found[int(entry.name)] = said.decode(errors="replace"), node_of(int(entry.name))
    return found


@dataclass
class Orphans(threading.Thread):
    """Looks every second how long runs are STARTED that no process executes, and remembers the longest time."""

    address: str
    longest_s: float = 0.0
    ended: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        super().__init__(daemon=True)

    def __hash__(self) -> int:
        return id(self)

    def run(self) -> None:
        import psycopg

        since = dict[str, float]()
        while not self.ended.wait(1.0):
            try:
                with psycopg.connect(self.address, autocommit=True, connect_timeout=5) as opened:
                    rows = opened.execute("select run_id from runs where status = 'STARTED'").fetchall()
            except psycopg.Error:
                continue  # PostgreSQL is one of those that are killed
            alive, now = [said for said, _ in executing().values()], time.monotonic()
            orphans = {run for (run,) in rows if not any(run in said for said in alive)}
            since = {run: since.get(run, now) for run in orphans}
            self.longest_s = max([self.longest_s, *(now - began for began in since.values())])


class Opened(threading.Thread):
    """Which nodes open files below which node's scratch folder, as the kernel tells of each open (fanotify). The
    folders become mounts of their own, which needs root; elsewhere nothing is seen, and `is_on` says so."""

    _INIT, _ADD, _OPEN = 0x1 | 0x10, 0x1 | 0x10, 0x20  # close-on-exec, no limit; add, of a mount; FAN_OPEN
    _EVENT = struct.Struct("IBBHQii")

    def __init__(self, folders: Mapping[str, Path]) -> None:
        super().__init__(daemon=True)
        self.counts: dict[tuple[str, str], int] = {}  # by the node that opens and the node whose folder it is
        self._folders, self._nodes = folders, dict[int, str]()
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd = libc.fanotify_init(self._INIT, os.O_RDONLY | os.O_CLOEXEC) if os.geteuid() == 0 else -1
        self._mounted = list[Path]()
        self.is_on = self._fd >= 0
        for folder in folders.values():
            folder.mkdir(exist_ok=True)
            if self.is_on:
                mount = ["mount", "--bind", str(folder), str(folder)]
                self.is_on = subprocess.run(mount, capture_output=True, check=False).returncode == 0
            if self.is_on:
                self._mounted.append(folder)
                path, mask = str(folder).encode(), ctypes.c_uint64(self._OPEN)
                self.is_on = libc.fanotify_mark(self._fd, self._ADD, mask, -100, path) == 0
        if self.is_on:
            self.start()

    def run(self) -> None:
        """Count each open until the folders are let go."""
        while True:
            try:
                read = os.read(self._fd, 1 << 16)
            except OSError:
                return
            while read:
                length, *_, fd, pid = self._EVENT.unpack_from(read)
                read = read[length:]
                if fd < 0:
                    continue
                path = str(Path(f"/proc/self/fd/{fd}").readlink())
                os.close(fd)
                with suppress(OSError):  # it ended a moment ago; what it was is known if it opened a file before
                    self._nodes[pid] = node_of(pid)
                owner = next((name for name, folder in self._folders.items() if path.startswith(f"{folder}/")), "")
                pair = self._nodes.get(pid, "?"), owner
                self.counts[pair] = self.counts.get(pair, 0) + 1

    def strangers(self) -> dict[tuple[str, str], int]:
        """Opens of files of one node by processes of another, or by ones of which nobody knows whose they were."""
        nodes = {*self._folders, "?"}
        return {pair: n for pair, n in self.counts.items() if pair[0] in nodes and pair[0] != pair[1]}

    def let_go(self) -> None:
        """The folders are mounts no more."""
        for folder in self._mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=False)
        if self._fd >= 0:
            os.close(self._fd)
