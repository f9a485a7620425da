"""Replace a batch's inline media by references to files to publish beside it.

A batch file with its clips inline takes 300 KB per call; with references a call takes 2 KB, and a clip is stored once
for all regimes and runs. Providers differ in the addresses that they read: OpenAI and Anthropic take https for images,
Gemini the URI of its File API or of Cloud Storage, vLLM https, and file:// below `--allowed-local-media-path`.
"""

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from traps_pipeline.base.files import write_bytes

FOLDER = "media"
SUFFIX = {"image/jpeg": ".jpg", "video/mp4": ".mp4"}
_DATA, _BASE64 = "data:", ";base64,"


@dataclass(frozen=True)
class MediaReferences:
    """The folder that media are written to, and its future public address."""

    folder: Path
    address: str

    def of(self, kind: str, data: str) -> str:
        """Return the address of a medium, given as base64; its file is written once."""
        content = base64.b64decode(data, validate=True)
        name = hashlib.sha256(content).hexdigest()[:32] + SUFFIX.get(kind, "")
        if not (self.folder / name).exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self.folder / name, content)
        return f"{self.address.rstrip('/')}/{name}"

    def instead_of(self, value: Any) -> Any:
        """Return a body with an address for each inline medium, in the form of its API.

        These are OpenAI's data URIs, Gemini's inline data, and Anthropic's sources. Everything else is unchanged.
        """
        match value:
            case str() if value.startswith(_DATA) and _BASE64 in value[:64]:
                kind, _, data = value.removeprefix(_DATA).partition(_BASE64)
                return self.of(kind, data)
            case {"type": "base64", "media_type": str(kind), "data": str(data)}:
                return {"type": "url", "url": self.of(kind, data)}
            case {"inline_data": {"mime_type": str(kind), "data": str(data)}, **rest}:
                return {"file_data": {"mime_type": kind, "file_uri": self.of(kind, data)}, **rest}
            case {"inlineData": {"mimeType": str(kind), "data": str(data)}, **rest}:
                return {"fileData": {"mimeType": kind, "fileUri": self.of(kind, data)}, **rest}
            case Mapping():
                return {key: self.instead_of(member) for key, member in value.items()}
            case list():
                return [self.instead_of(member) for member in value]
            case _:
                return value
