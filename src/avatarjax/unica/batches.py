"""Which frames a training step sees: windows of a recording, drawn from the step number alone."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from avatarjax.data import sequences
from avatarjax.data.sequences import Recording

CENTRE = 2  # frame t of a group of four


@dataclasses.dataclass(frozen=True, eq=False)
class Windows:
    """All windows of `length` frames of a recording; turning marks those whose last frame is in a turn.

    first (g,) the first frame of each window.
    """

    recording: Recording
    first: Int[np.ndarray, "g"]
    turning: Bool[np.ndarray, "g"]
    length: int

    def groups(self, chosen: Int[np.ndarray, "b"], scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Normalised texels (b, 4, t, 3) of windows of four, and the action (b,) of frame t (UNICA 3.3)."""
        frames = self.frames(chosen)
        origin = self.recording.roots[frames[:, CENTRE]]
        shift = self.recording.roots[frames] - origin[:, None]
        texels = scale * (self.recording.texels[frames] + shift[:, :, None]) + 0.5
        return np.asarray(texels, np.float32), np.asarray(self.recording.actions[frames[:, CENTRE]])

    def frames(self, chosen: Int[np.ndarray, "b"]) -> Int[np.ndarray, "b length"]:
        """Frame numbers of windows."""
        return self.first[chosen][:, None] + np.arange(self.length)


def windows(recording: Recording, length: int, turn_window: tuple[int, int]) -> Windows:
    """The windows of a recording; frames inside `turn_window` after a key change count as turning."""
    ends = sequences.group_ends(recording.sequence, length)
    near = sequences.turning(recording.actions, recording.sequence, turn_window)
    return Windows(recording, ends - length + 1, near[ends], length)


def draw(
    allowed: Bool[np.ndarray, "g"],
    special: Bool[np.ndarray, "g"],
    fraction: float,
    count: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, "count"]:
    """Indices of allowed windows; each is a special one with probability `fraction` (UNICA C.2: 70 % turning)."""
    among, others = np.flatnonzero(allowed & special), np.flatnonzero(allowed & ~special)
    if not len(among) or not len(others):
        return rng.choice(np.flatnonzero(allowed), count)
    pick_special = rng.random(count) < fraction
    return np.where(pick_special, rng.choice(among, count), rng.choice(others, count))


def generator(seed: int, step: int) -> np.random.Generator:
    """The random numbers of one training step, the same whenever it runs."""
    return np.random.default_rng((seed, step))


def frame_images(texels: Float[np.ndarray, "b t 3"], roots: Float[np.ndarray, "b 3"], scale: float) -> np.ndarray:
    """Root-relative texels displaced by `roots` (metres), in normalised space."""
    return (scale * (texels + roots[:, None]) + 0.5).astype(np.float32)
