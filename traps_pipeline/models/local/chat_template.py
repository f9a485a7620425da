"""Render a checkpoint's chat template, which is foreign code, in a process with bounds on time and memory.

The library's sandbox lets a template run no code of its own, but loop for ever and ask for any memory.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock
from typing import Any

from traps_pipeline.base.errors import TrapsError

MAX_S, MAX_BYTES, MAX_CHARACTERS = 10, 2**30, 1_000_000  # CPU seconds, memory and length of a prompt
_TOO_MUCH = f"it takes more than {MAX_S} s, {MAX_BYTES / 1e9:.0f} GB or {MAX_CHARACTERS:,} characters"
_lock, _renderer = Lock(), list[Connection]()  # to the process, while there is one


def render(checkpoint: str, template: str, turns: Sequence[Mapping[str, Any]], variables: Mapping[str, Any]) -> str:
    """Return a model's prompt from chat turns, as transformers renders it. Raises TrapsError if the template fails."""
    request = {"chat_template": template, "conversations": [turns], "add_generation_prompt": True, **variables}
    with _lock:
        try:
            if not _renderer:
                ours, theirs = Pipe()
                # No process of `multiprocessing`: that would run a caller's script once more, paid calls and all.
                code = f"from {__name__} import _serve, Connection; _serve(Connection({theirs.fileno()}))"
                path = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
                subprocess.Popen([sys.executable, "-c", code], pass_fds=[theirs.fileno()], env=path)
                theirs.close()
                _renderer.append(ours)
            _renderer[0].send_bytes(json.dumps(request).encode())
            text, failure = json.loads(_renderer[0].recv_bytes())
        except (EOFError, OSError):  # the kernel has ended the process
            text, failure = "", _TOO_MUCH
            _renderer.clear()
    if failure:
        raise TrapsError(
            f"{checkpoint}: its chat template fails ({failure}); give the checkpoint another template, or "
            "`params.template` the variables it wants"
        )
    return text


def _serve(connection: Connection) -> None:
    """Answer each request by a text and a failure, of which one is empty, until the other side has gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other side
    from transformers.utils.chat_template_utils import render_jinja_template

    pages = Path("/proc/self/statm")
    if pages.exists():  # elsewhere only the time is bounded
        size = int(pages.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MAX_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    while True:
        try:
            request = json.loads(connection.recv_bytes())
        except EOFError:
            return
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + MAX_S + 1, hard))
        try:
            (text,), _ = render_jinja_template(**request)
            reply = (text, "") if len(text) <= MAX_CHARACTERS else ("", _TOO_MUCH)
        except MemoryError:
            reply = "", _TOO_MUCH
        except Exception as error:  # noqa: BLE001 - whatever a template raises becomes its failure
            reply = "", f"{type(error).__name__}: {str(error)[:200]}"
        connection.send_bytes(json.dumps(reply).encode())
