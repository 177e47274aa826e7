"""`pav frames`, and pictures that are never half there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from pav_blender.cli import main
from pav_blender.core import images
from pav_blender.core.errors import InputError
from pav_blender.core.frame_files import SUFFIXES, damage, look, ranges
from pav_blender.core.rendering.frames import EXR, PNG8, PNG16, format_of, provenance, write_frame


@pytest.fixture
def picture():
    return np.random.default_rng(0).random((40, 60, 4)).astype(np.float32)


@pytest.fixture
def folder(tmp_path, picture):
    """Frames 8 to 14: 9 is empty, 11 torn, 12 missing, 13 not a picture; and a temporary file."""
    for number in (8, 10, 11, 14):
        images.write_rgba(tmp_path / f"f{number:04d}.png", picture)
    torn = (tmp_path / "f0011.png").read_bytes()
    (tmp_path / "f0011.png").write_bytes(torn[: len(torn) - 40])
    (tmp_path / "f0009.png").touch()
    (tmp_path / "f0013.png").write_text("placeholder")
    (tmp_path / ".f0012.partial-x7_k.png").write_bytes(torn[:100])
    (tmp_path / "notes 7.txt").write_text("")
    (tmp_path / "scene12.blend").touch()
    (tmp_path / ".me.partial-abc.pav").touch()
    return tmp_path


def test_frames_are_listed_cleared_and_then_clean(folder, capsys):
    before = sorted(folder.iterdir())
    assert main(["frames", str(folder)]) == 1
    said = capsys.readouterr().out
    assert sorted(folder.iterdir()) == before
    assert f"damaged: {folder / 'f0009.png'} (empty)" in said
    assert f"damaged: {folder / 'f0011.png'} (the picture is damaged" in said
    assert f"damaged: {folder / 'f0013.png'} (not a readable picture" in said
    assert "3 whole, 3 damaged, 4 missing" in said
    assert "missing: 9, 11-13" in said

    assert main(["frames", str(folder), "--repair"]) == 0
    kept = sorted(path.name for path in folder.iterdir())
    assert kept == [
        ".me.partial-abc.pav", "f0008.png", "f0010.png", "f0014.png", "notes 7.txt",
        "scene12.blend",
    ]  # fmt: skip
    capsys.readouterr()
    assert main(["frames", str(folder)]) == 0
    assert "3 whole, 0 damaged, 4 missing" in capsys.readouterr().out


def test_a_range_says_what_should_be_there(folder, capsys):
    main(["frames", str(folder), "--repair"])
    assert main(["frames", str(folder), "--range", "6-16"]) == 1
    assert "missing: 6-7, 9, 11-13, 15-16" in capsys.readouterr().out
    assert main(["frames", str(folder), "--range", "14-14"]) == 0
    for words in (["--range", "9"], ["--range", "9-8"]):
        assert main(["frames", str(folder), *words]) == 2
        assert "write A-B" in capsys.readouterr().err
    assert main(["frames", str(folder / "none")]) == 2


def test_several_folders_and_the_worst_counts(folder, tmp_path_factory, picture):
    clean = tmp_path_factory.mktemp("clean")
    images.write_rgba(clean / "1.png", picture)
    assert main(["frames", str(clean)]) == 0
    assert main(["frames", str(folder), str(clean)]) == 1


@pytest.mark.parametrize("suffix", sorted(SUFFIXES))
def test_every_format_is_read_to_its_end(tmp_path, picture, suffix):
    """Else a whole picture of some format would be taken for a damaged one, and removed."""
    import OpenImageIO as oiio

    path = tmp_path / f"1{suffix}"
    if suffix == ".exr":
        write_frame(path, EXR, picture, None, picture[..., 0], {})
    else:
        spec = oiio.ImageSpec(60, 40, 3, "float" if suffix == ".hdr" else "uint8")
        sink = oiio.ImageOutput.create(str(path))
        assert sink.open(str(path), spec)
        assert sink.write_image(np.ascontiguousarray(picture[..., :3]))
        sink.close()
    assert damage(path) == ""
    whole = path.read_bytes()
    for share in (0.01, 0.3, 0.6):  # a TGA ends with a thumbnail
        path.write_bytes(whole[: int(len(whole) * share)])
        assert damage(path)


def test_ranges_of_numbers():
    assert ranges([]) == ""
    assert ranges([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"


def test_parts_of_an_exr_are_all_read(tmp_path, picture):
    """Blender 5 writes a part a pass: a file may end well behind its first picture."""
    import OpenImageIO as oiio

    path = tmp_path / "1.exr"
    specs = [oiio.ImageSpec(60, 40, 3, "float") for _ in range(2)]
    sink = oiio.ImageOutput.create(str(path))
    assert sink.open(str(path), specs)
    for part, spec in enumerate(specs):
        if part:
            assert sink.open(str(path), spec, "AppendSubimage")
        assert sink.write_image(np.ascontiguousarray(picture[..., :3]))
    sink.close()
    assert damage(path) == ""
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * 0.8)])
    assert damage(path)


def test_formats_hold_what_they_say(tmp_path, picture):
    import OpenImageIO as oiio

    from pav_blender.core.rendering.colour import linear_premultiplied

    depth = np.where(picture[..., 3] > 0.5, picture[..., 0], np.inf)
    told = provenance(["me.pav"], ["grey suit"], 7, "final")
    for format in (PNG8, PNG16, EXR):
        path = tmp_path / f"{format.name}{format.suffix}"
        write_frame(path, format, picture, None, depth, told)
        assert told.items() <= images.read_metadata(path).items()
        source = oiio.ImageInput.open(str(path))
        spec = source.spec()
        kinds = {"png8": "uint8", "png16": "uint16", "exr": "half"}
        stored = [str(kind) for kind in spec.channelformats] or [str(spec.format)] * spec.nchannels
        assert stored[:4] == [kinds[format.name]] * 4
        if format is EXR:
            pixels = source.read_image("float")
            assert (spec.channelnames[4], stored[4]) == ("Z", "float")
            np.testing.assert_array_equal(pixels[..., 4], np.where(depth < 9, depth, 1e10))
            np.testing.assert_allclose(pixels[..., :4], linear_premultiplied(picture), atol=1e-3)
        source.close()
    sixteen = images._read(tmp_path / "png16.png", "native")
    assert np.abs(sixteen / 65535 - picture).max() < 1 / 65535


def test_a_format_and_an_ending_go_together():
    assert (format_of("a.png"), format_of("a.exr"), format_of("a.png", "png16")) == (
        PNG8, EXR, PNG16,
    )  # fmt: skip
    for path, name, message in (
        ("a.jpg", None, r"\.png or \.exr"),
        ("a.png", "exr", r"end in \.exr"),
        ("a.png", "png12", "one of png8, png16, exr"),
    ):
        with pytest.raises(InputError, match=message):
            format_of(path, name)


KILLED = """
import os, signal, sys
import OpenImageIO
from pav_blender.core import images

class Sink:
    '''The third picture's bytes are on disk, its end is not: there the power goes.'''
    written = 0
    def __init__(self, path): self.real = OpenImageIO.ImageOutput.create(path)
    def __getattr__(self, name): return getattr(self.real, name)
    def write_image(self, pixels):
        Sink.written += 1
        if Sink.written == 3:
            self.real.write_scanlines(0, len(pixels) // 2, 0, pixels[: len(pixels) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
        return self.real.write_image(pixels)

class Output: create = staticmethod(Sink)
class Fake:
    ImageOutput = Output
    def __getattr__(self, name): return getattr(OpenImageIO, name)
images._oiio = Fake
from pav_blender.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_a_killed_render_leaves_no_half_file_under_a_final_name(
    toy_path, toy_avatar_path, tmp_path, suffix
):
    out = tmp_path / "out"
    words = ["render", toy_avatar_path, "--track", f"{toy_path}:plain", "--appearance", "plain"]
    words += ["--size", "64", "--quality", "preview", "--out", out / f"####.{suffix}"]
    command = [sys.executable, "-c", KILLED, *map(str, words)]
    done = subprocess.run(command, capture_output=True, timeout=120, env=os.environ)
    assert done.returncode == -signal.SIGKILL, done.stderr
    found = look(out)
    assert (len(found.whole), found.damaged, len(found.left)) == (2, {}, 1)
    assert main(["frames", str(out), "--repair"]) == 0
    assert sorted(out.iterdir()) == found.whole
