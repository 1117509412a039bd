"""Files of frames: an animated WebP, a strip of stills as PNG, or an MP4 film."""

import io
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tcmrl_data.envs.base import Picture
from tcmrl_data.foundation.errors import RenderingError

ENDINGS = (".webp", ".png", ".mp4")
STRIP_ENDING = ".png"

FILM_MS = 4_000
"""A film takes about four seconds, however long its episode is, …"""
SHORTEST_MS, LONGEST_MS = 25, 200
"""… unless its frames would stand for less or more than this."""
LAST_MS = 1_000
"""The last frame stands longer, so that one sees how the episode ended."""

WEBP_QUALITY = 50
STRIP_COLORS = 128


def check_ending(file: Path) -> None:
    """Refuses names of files that cannot be written.

    Raises:
        RenderingError: another ending, or an MP4 without the program ffmpeg.
    """
    if file.suffix.lower() not in ENDINGS:
        raise RenderingError(f"--out {file}: the name must end in {', '.join(ENDINGS)}")
    if file.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise RenderingError(
            f"--out {file}: MP4 films are made by the program ffmpeg, which is not installed; install it, "
            "or choose a name that ends in .webp"
        )


def encode(pictures: Sequence[Picture], ending: str) -> bytes:
    """The bytes of a file.

    Args:
        pictures: of a film in order, all of one size; of a strip, the finished strip alone.
        ending: one of `ENDINGS`.
    """
    if ending == STRIP_ENDING:
        return _png(pictures[0])
    shown = min(max(FILM_MS // len(pictures), SHORTEST_MS), LONGEST_MS)
    return _webp(pictures, shown) if ending == ".webp" else _mp4(pictures, shown)


def _png(strip: Picture) -> bytes:
    """A PNG with a palette, a third of the size of one without."""
    from PIL import Image

    image = Image.fromarray(strip).quantize(STRIP_COLORS, dither=Image.Dither.NONE)
    target = io.BytesIO()
    image.save(target, "PNG", optimize=True)
    return target.getvalue()


def _webp(pictures: Sequence[Picture], shown: int) -> bytes:
    from PIL import Image

    first, *others = [Image.fromarray(picture) for picture in pictures]
    target = io.BytesIO()
    first.save(
        target,
        "WEBP",
        save_all=True,
        append_images=others,
        duration=[shown] * len(others) + [LAST_MS],
        loop=0,
        quality=WEBP_QUALITY,
        method=4,
    )
    return target.getvalue()


def _mp4(pictures: Sequence[Picture], shown: int) -> bytes:
    """H.264, which browsers show.

    Raises:
        RenderingError: ffmpeg fails; the message has its last line.
    """
    height, width, _ = pictures[0].shape
    frames = [*pictures, *[pictures[-1]] * (LAST_MS // shown)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "film.mp4")
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(1_000 / shown)]
        target = ["-pix_fmt", "yuv420p", "-movflags", "+faststart", str(file)]
        done = subprocess.run(
            ["ffmpeg", "-v", "error", *source, "-i", "-", *target],
            input=np.stack(frames).tobytes(),
            capture_output=True,
            check=False,
        )
        if done.returncode:
            words = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
            raise RenderingError(f"ffmpeg cannot make a film: {words[-1][:200]}; choose a .webp file")
        return file.read_bytes()
