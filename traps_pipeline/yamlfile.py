"""Files that people write, read safely: YAML and JSON Lines, checked by pydantic models, errors in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from traps_pipeline.errors import TrapsError

Model = TypeVar("Model", bound=BaseModel)


def read_yaml(path: Path) -> Any:
    """Parsed YAML (safe loader). Raises TrapsError naming file, line and the parser's complaint."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TrapsError(f"{path}: cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise TrapsError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a JSON Lines file that hold anything, with their numbers from 1. Raises TrapsError."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TrapsError(f"{path}: cannot be read ({error}); restore it from git") from error
    for number, line in enumerate(text.split("\n"), start=1):  # not splitlines: JSON may hold U+2028 as it is
        if line.strip():
            yield number, line


def parse_yaml_model(
    model: type[Model], data: Any, path: Path, where: str = "", context: Mapping[str, Any] | None = None
) -> Model:
    """Validate parsed YAML; validators see `context`. Raises TrapsError naming file, entry and field."""
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        raise TrapsError(f"{path}{where and ': ' + where}: {explain(error)}") from error


def explain(error: ValidationError) -> str:
    """A validation error in one line: field and complaint, `; ` between them."""
    parts = ((".".join(map(str, e["loc"])), e["msg"].removeprefix("Value error, ")) for e in error.errors())
    return "; ".join(f"{field}: {message}" if field else message for field, message in parts)
