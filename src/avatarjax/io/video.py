"""Videos as H.264 mp4 through PyAV."""

from __future__ import annotations

import os
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8

from avatarjax.io import atomic


def write_video(
    path: str | os.PathLike, frames: Iterable[UInt8[np.ndarray, "h w 3"]], *, fps: int = 30, quality: int = 18
) -> None:
    """Write RGB frames of one size, odd sides padded to even by repeating the border; `quality` is x264's CRF.

    Raises ValueError where there are no frames or their sizes differ; the file then stays as it was.
    """
    import av

    with atomic.replacing(path) as temporary, av.open(str(temporary), mode="w") as container:
        stream, shape = None, None
        for frame in frames:
            if shape not in (None, frame.shape):
                raise ValueError(f"{path}: a frame of shape {frame.shape} follows frames of shape {shape}")
            shape = frame.shape
            padded = np.pad(frame, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge")
            if stream is None:
                stream = container.add_stream("libx264", rate=fps, options={"crf": str(quality)})
                stream.height, stream.width, stream.pix_fmt = padded.shape[0], padded.shape[1], "yuv420p"
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24")):
                container.mux(packet)
        if stream is None:
            raise ValueError(f"{path}: a video needs at least one frame")
        for packet in stream.encode():
            container.mux(packet)
