"""Run Dagster's web server behind a guard (`traps ui`).

`webguard` guards it; its daemon and their code server run beside it. Dagster's own server accepts any request that
reaches its port: a page of another site, opened in the same browser, could launch runs, which spend money, and wipe
history. `dagster dev` starts that server, and leaves processes behind if SIGINT is ignored; `serve_with_dagster` avoids
both.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NoReturn

import yaml

from traps_pipeline.base import process_tree
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.webguard import Guard
from traps_pipeline.pipeline.previews import STUDY_URL
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import Route

TOKEN_VARIABLE = "TRAPS_UI_TOKEN"
DANGER = "launch runs, which spend this study's budget"
STOP_S = 45.0  # for what is told to stop: a run waits 30 s for its calls in flight
AGAIN = "Ctrl-C again stops at once"
_MODULE = "traps_pipeline.definitions"
_DRAIN_S, _PAUSE_S = 3, 0.1
_PATIENCE = {"DAGSTER_GRPC_TIMEOUT_SECONDS": "600"}  # starting a run on a busy machine takes longer than Dagster's 60 s
SERVED_FOLDERS = ("reports", "site", "clips")


def serve_with_dagster(host: str, port: int, token: str) -> NoReturn:
    """Run web server, daemon and code server until KeyboardInterrupt; raise TrapsError if one of them ends."""
    with tempfile.TemporaryDirectory() as folder:
        address, workspace = f"{folder}/code.sock", Path(folder) / "workspace.yaml"
        location = {"grpc_server": {"socket": address, "location_name": _MODULE}}
        workspace.write_text(yaml.safe_dump({"load_from": [location]}), encoding="utf-8")
        code_server = ("dagster", "code-server", "start", "-m", _MODULE, "--location-name", _MODULE)
        try:
            name_of = {_start(*code_server, "--socket", address, "--log-level", "warning"): "code server"}
            _wait_for_socket(address, name_of)
            name_of[_start(__name__, str(workspace), host, str(port), token=token)] = "web server"
            name_of[_start("dagster._daemon", "run", "-w", str(workspace))] = "daemon"
            pid, code = process_tree.wait_for(name_of)
        except KeyboardInterrupt:
            print(f"stopping: runs store their calls in flight, within {STOP_S:.0f} s; {AGAIN}", file=sys.stderr)
            raise
        finally:
            process_tree.stop_descendants(STOP_S)
    raise TrapsError(
        f"Dagster's {name_of[pid]} ended by itself (exit code {code}), and all others with it: its lines stand above"
    )


def _start(module: str, *arguments: str, token: str | None = None) -> int:
    """Start a module and return its process id; token: passed in its environment."""
    environment = _PATIENCE | os.environ | {"DAGSTER_IS_DEV_CLI": "1"} | ({TOKEN_VARIABLE: token} if token else {})
    return subprocess.Popen([sys.executable, "-m", module, *arguments], env=environment).pid


def _wait_for_socket(address: str, started: dict[int, str]) -> None:
    """Wait until the code server answers at its socket, or has ended."""
    while not os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
        with socket.socket(socket.AF_UNIX) as probe:
            if probe.connect_ex(address) == 0:
                return
        time.sleep(_PAUSE_S)


def study_route(workspace: Workspace) -> Route:
    """Return a route to the study's report, site and clips, which Dagster links to."""
    from starlette.responses import FileResponse, PlainTextResponse, Response
    from starlette.routing import Route

    def study_file(request: Request) -> Response:
        path = PurePosixPath(request.path_params["path"])
        if path.parts[0] in SERVED_FOLDERS and not any(part.startswith(".") for part in path.parts):
            file = workspace.resolve(path.as_posix())
            is_inside = file.resolve().is_relative_to((workspace.root / path.parts[0]).resolve())
            if is_inside and file.is_file():
                return FileResponse(file)
        return PlainTextResponse(f"the study has no file {path}; materialize the asset that makes it\n", 404)

    return Route(f"{STUDY_URL}/{{path:path}}", study_file)


def main() -> None:
    """Serve Dagster's pages behind the guard; arguments: workspace file, host, port."""
    import uvicorn
    from dagster import DagsterInstance
    from dagster._core.workspace.context import WorkspaceProcessContext
    from dagster._core.workspace.load_target import WorkspaceFileTarget
    from dagster_webserver.app import create_app_from_workspace_process_context

    workspace, host, port, token = sys.argv[1], sys.argv[2], int(sys.argv[3]), os.environ[TOKEN_VARIABLE]
    with (
        DagsterInstance.get() as instance,
        WorkspaceProcessContext(instance, workspace_load_target=WorkspaceFileTarget([workspace])) as context,
    ):
        app = create_app_from_workspace_process_context(context)
        app.routes.insert(0, study_route(Workspace.open()))  # Dagster's own last route matches every path
        address = f"[{host}]" if ":" in host else host
        print(f"\n  open http://{address}:{port}/?token={token}\n", file=sys.stderr, flush=True)
        uvicorn.run(
            Guard(app, token, host, port),
            host=host,
            port=port,
            access_log=False,
            log_level="warning",
            timeout_graceful_shutdown=_DRAIN_S,
        )


if __name__ == "__main__":
    main()
