"""The table of floors: a module imports only from floors below, its own room, or a door that is meant."""

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "avatarjax"
FLOORS = {
    0: ["gaussians", "cameras", "rotations", "io", "assets"],
    1: ["splat", "posmap", "nets"],
    2: ["diffusion", "physics", "data", "metrics", "train"],
    3: ["unica", "smad"],
    4: ["play"],
}
ROOM_FLOOR = {room: floor for floor, rooms in FLOORS.items() for room in rooms}
SAME_FLOOR_DOORS = {("data", "physics"), ("gaussians", "rotations"), ("cameras", "rotations"), ("io", "gaussians")}
# Not on the GPU machines: a training or rollout step must not need them, so modules import them where they are used.
LAZY = {"jaxopt", "trimesh", "embreex", "OpenImageIO", "tyro", "matplotlib", "av", "skimage", "grain"}


def modules():
    return sorted(p for p in SOURCE.rglob("*.py") if p != SOURCE / "__init__.py")


def imports(tree, top_level_only):
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the room they come from"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


def room_of(dotted):
    parts = dotted.split(".")
    return parts[1] if parts[0] == "avatarjax" and len(parts) > 1 else None


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(SOURCE)))
def test_imports_go_down(path):
    room = path.relative_to(SOURCE).parts[0].removesuffix(".py")
    assert room in ROOM_FLOOR, f"{room} stands on no floor: add it to the table of floors"
    for name in imports(ast.parse(path.read_text()), top_level_only=False):
        other = room_of(name)
        if other is None or other == room:
            continue
        assert other in ROOM_FLOOR, f"{path.name} imports {name}, which stands on no floor"
        downwards = ROOM_FLOOR[other] < ROOM_FLOOR[room]
        assert downwards or (room, other) in SAME_FLOOR_DOORS, f"{path.name} may not import {name}"


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(SOURCE)))
def test_heavy_packages_are_imported_where_they_are_used(path):
    for name in imports(ast.parse(path.read_text()), top_level_only=True):
        assert name.split(".")[0] not in LAZY, f"{path.name} imports {name} at its top"
