import numpy as np
import pytest

from avatarjax.io import exr


@pytest.fixture
def floats():
    rng = np.random.default_rng(0)
    pixels = (rng.normal(size=(9, 14, 4)) * 10.0 ** rng.integers(-30, 30, (9, 14, 4))).astype(np.float32)
    pixels.reshape(-1)[:6] = [0.0, -0.0, np.inf, -np.inf, 1e-42, np.finfo(np.float32).max]
    return pixels


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_float_pixels_round_trip_bit_for_bit(floats, tmp_path, channels):
    exr.write_exr(tmp_path / "a.exr", floats[..., :channels])
    again = exr.read_exr(tmp_path / "a.exr")
    assert again.dtype == np.float32
    np.testing.assert_array_equal(again.view(np.uint32), np.ascontiguousarray(floats[..., :channels]).view(np.uint32))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_bytes_round_trip_also_where_they_are_transparent(tmp_path, channels):
    pixels = np.random.default_rng(1).integers(0, 256, (9, 14, 4), np.uint8)
    pixels[:4, :, 3] = 0
    exr.write_png(tmp_path / "a.png", pixels[..., :channels])
    np.testing.assert_array_equal(exr.read_png(tmp_path / "a.png"), pixels[..., :channels])


def test_a_float_file_is_written_whole_or_not_at_all(floats, tmp_path):
    exr.write_exr(tmp_path / "new folder" / "a.exr", floats)
    assert [p.name for p in (tmp_path / "new folder").iterdir()] == ["a.exr"]


@pytest.mark.parametrize("read, name", [(exr.read_exr, "a.exr"), (exr.read_png, "a.png")])
class TestBrokenFiles:
    def write(self, path):
        pixels = np.random.default_rng(2).integers(0, 256, (64, 64, 3), np.uint8)
        if path.suffix == ".png":
            exr.write_png(path, pixels)
        else:
            exr.write_exr(path, pixels.astype(np.float32))

    def test_a_missing_one_is_named(self, read, name, tmp_path):
        with pytest.raises(ValueError, match=rf"{name} does not exist"):
            read(tmp_path / name)

    @pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.95])
    def test_a_truncated_one_is_named(self, read, name, tmp_path, share):
        self.write(tmp_path / name)
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match=rf"{name} cannot be read"):
            read(tmp_path / name)

    def test_something_else_is_named(self, read, name, tmp_path):
        (tmp_path / name).write_text("not a picture")
        with pytest.raises(ValueError, match=rf"{name} cannot be read"):
            read(tmp_path / name)
