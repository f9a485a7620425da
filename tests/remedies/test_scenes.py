"""What errors about families and their parts say to do lets the family be read, drawn or shown."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from tests.remedies.remedied import remedied
from tests.scenes.test_registry import FAMILY_TEXT
from traps_pipeline.scenes import registry
