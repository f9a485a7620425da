"""Serve local pages: a guarded FastAPI app, templates, errors and clips.

Only files that a study's tables name are served. The guard (`webguard`) admits only holders of the token, and refuses
foreign hosts, foreign origins and every change that is not a POST of JSON.
"""

import hashlib
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.webguard import Guard
from traps_pipeline.report.explorer.site import WEB as SHARED
from traps_pipeline.report.writing import environment
from traps_pipeline.storage.workspace import Workspace

WEB = Path(__file__).parent / "web"


class NotFound(TrapsError):
    """The study has nothing of this name (404)."""


class Refused(TrapsError):
    """A page's request that cannot be read (HTTP 400)."""


class Conflict(TrapsError):
    """A page's request that another person's decision has overtaken (HTTP 409)."""


def new_app() -> FastAPI:
    """Return an app without docs pages; a TrapsError becomes sentence and status."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.exception_handler(TrapsError)
    async def error_response(request: Request, error: TrapsError) -> Response:
        status = 404 if isinstance(error, NotFound) else 409 if isinstance(error, Conflict) else 400
        return JSONResponse({"error": str(error)}, status)

    @app.exception_handler(RequestValidationError)
    async def malformed(request: Request, error: RequestValidationError) -> Response:
        fields = sorted({".".join(map(str, error_details["loc"][1:])) or "body" for error_details in error.errors()})
        return JSONResponse({"error": f"not understood: {', '.join(fields)}"}, 400)

    return app


def page_html(template: str, **values: Any) -> str:
    """Return a page with the explorer's look and a policy of its own content only."""
    style = (SHARED / "style.css").read_text(encoding="utf-8")
    digest = b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    return environment(WEB).get_template(template).render(style=style, style_digest=digest, **values)


@cache
def script(*names: str) -> str:
    """Return sources of this room and the explorer as one scoped classic script."""
    paths = [WEB / name if (WEB / name).is_file() else SHARED / name for name in names]
    sources = "\n".join(path.read_text(encoding="utf-8") for path in paths)
    return f'(() => {{\n"use strict";\n{sources}\n}})();\n'


def study_file(workspace: Workspace, relative: str) -> Path:
    """Return a clip that the study's tables name. Raises NotFound for any other path."""
    path = workspace.resolve(relative)
    is_inside = path.resolve().is_relative_to((workspace.root / "clips").resolve())
    if not is_inside or not path.is_file():
        raise NotFound("the study has no such clip")
    return path


@dataclass(frozen=True)
class ServerSettings:
    """A server's address, token (or tokens with their persons) and command. behind: an HTTPS proxy in front, if any."""

    host: str
    port: int
    tokens: str | Mapping[str, str]
    command: str
    behind: str = ""

    def addresses(self) -> dict[str, str]:
        """Return the address to open, by person ("" if there is one for all)."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        base = self.behind.rstrip("/") or f"http://{host}:{self.port}"
        tokens = {self.tokens: ""} if isinstance(self.tokens, str) else self.tokens
        return {person: f"{base}/?token={quote(token)}" for token, person in tokens.items()}


def serve(app: FastAPI, listening: ServerSettings) -> None:
    """Serve an app behind the guard until Ctrl-C, and print addresses with tokens."""
    import uvicorn

    for person, address in listening.addresses().items():
        print(f"{person}: open {address}" if person else f"open {address}", flush=True)
    endpoint = listening.host, listening.port
    guarded = Guard(app, listening.tokens, *endpoint, command=listening.command, behind=listening.behind)
    uvicorn.run(guarded, host=endpoint[0], port=endpoint[1], access_log=False, log_level="warning")
