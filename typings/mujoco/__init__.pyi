# MuJoCo's native names come from a compiled module without stubs: pyright is told that any name is there.
from typing import Any

def __getattr__(name: str) -> Any: ...
