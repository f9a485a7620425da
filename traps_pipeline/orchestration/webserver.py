"""Dagster's web server behind a guard (`webguard`), so that only the person who started it can use it: `traps ui`.

Dagster's own server takes any request that reaches its port: a page of another site, opened in the same browser, could
launch runs, which spend money, and wipe history.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from traps_pipeline.base.webguard import Guard

TOKEN_VARIABLE = "TRAPS_UI_TOKEN"
DANGER = "launch runs, which spend this study's budget"


def serve_with_dagster(host: str, port: int, token: str) -> None:
    """`dagster dev` with this web server in the place of Dagster's own, until Ctrl-C."""
    from dagster._cli import dev

    start = vars(dev)["open_ipc_subprocess"]

    def start_ours(command: list[str], **named: Any) -> Any:
        ours = [command[0], "-m", __name__, *command[3:]] if command[1:3] == ["-m", "dagster_webserver"] else command
        return start(ours, **named)

    dev.__dict__["open_ipc_subprocess"] = start_ours  # the one place that starts it
    os.environ[TOKEN_VARIABLE] = token
    dev.dev_command.main(
        ["-h", host, "-p", str(port), "-m", "traps_pipeline.definitions"], prog_name="traps ui", standalone_mode=False
    )


def main() -> None:
    """Dagster's own command of its web server, with the guard before its app."""
    import uvicorn
    from dagster_webserver import cli

    run, token = uvicorn.run, os.environ[TOKEN_VARIABLE]

    def serve(app: Any, *, host: str, port: int, **named: Any) -> None:
        shown = f"[{host}]" if ":" in host else host
        print(f"\n  open http://{shown}:{port}/?token={token}\n", file=sys.stderr, flush=True)
        run(Guard(app, token, host, port), host=host, port=port, access_log=False, **named)

    uvicorn.__dict__["run"] = serve  # Dagster calls it by this name, with the app and its address
    cli.main()


if __name__ == "__main__":
    main()
