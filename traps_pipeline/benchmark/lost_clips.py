"""Find a study's missing clips without importing the renderer."""

from collections.abc import Sequence

from traps_pipeline.scenes.worlds.clip_notes import clip_note_path
from traps_pipeline.storage.benchmark_tables import VIDEOS
from traps_pipeline.storage.workspace import Workspace


def missing_clips(workspace: Workspace, category: str) -> Sequence[str]:
    """Return the paths of a category's clips that are missing or of a wrong size."""
    table = workspace.tables.read_arrow(VIDEOS, ["path", "size_bytes"], category=category)
    expected = dict(zip(table["path"].to_pylist(), table["size_bytes"].to_pylist(), strict=True))
    notes = {path: workspace.relative(clip_note_path(workspace.root / path)) for path in expected}
    sizes = workspace.sizes([*expected, *notes.values()])
    return [path for path, size in expected.items() if sizes.get(path) != size or notes[path] not in sizes]
