"""The archives that bundle wheels: what is fetched, what goes where."""

from __future__ import annotations

import hashlib
import tomllib
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[2]
TAGS = {
    "linux-x64": "manylinux_2_28_x86_64",
    "windows-x64": "win_amd64",
    "macos-arm64": "macosx_12_0_arm64",
}


@pytest.fixture
def tools(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    import build_extension
    import wheels

    monkeypatch.setenv("PIP_NO_INDEX", "1")
    return build_extension, wheels


def write_wheels(folder: Path) -> tuple[Path, dict[str, list[Path]]]:
    """A wheel a platform and Python, and their pins."""
    folder.mkdir(parents=True)
    made: dict[str, list[Path]] = {}
    for platform, tag in TAGS.items():
        for python in ("cp311", "cp313"):
            path = folder / f"pav_pretend-1.0-{python}-{python}-{tag}.whl"
            about = "pav_pretend-1.0.dist-info"
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr(f"{about}/METADATA", "Name: pav_pretend\nVersion: 1.0\n")
                archive.writestr(f"{about}/WHEEL", f"Wheel-Version: 1.0\nTag: {python}-{tag}\n")
                archive.writestr(f"{about}/RECORD", "")
            made.setdefault(platform, []).append(path)
    hashes = [
        f"--hash=sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
        for paths in made.values()
        for path in paths
    ]
    pins = folder / "pins.txt"
    pins.write_text(f"pav_pretend==1.0 {' '.join(hashes)}\n")
    return pins, made


@pytest.fixture
def pretend(tmp_path, tools, monkeypatch):
    pins, made = write_wheels(tmp_path / "index")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "index"))
    return pins, made


def write_source(folder: Path) -> Path:
    """A package that is packed in no time."""
    folder.mkdir()
    manifest = (ROOT / "pav_blender" / "blender_manifest.toml").read_text()
    (folder / "blender_manifest.toml").write_text(manifest)
    (folder / "__init__.py").write_text("")
    return folder


def test_each_platform_gets_its_own_wheels_for_both_pythons(tmp_path, tools, pretend):
    build_extension, _ = tools
    pins, made = pretend
    source = write_source(tmp_path / "pav_blender")
    (tmp_path / "out").mkdir()
    built = build_extension.build_with_wheels(tmp_path / "out", source=source, pins=pins)
    assert len(built) == 3
    for platform, paths in made.items():
        archive = tmp_path / "out" / f"pav_blender-0.1.0-{platform.replace('-', '_')}.zip"
        assert archive in built
        with zipfile.ZipFile(archive) as packed:
            names = {Path(name).name for name in packed.namelist() if name.endswith(".whl")}
            manifest = tomllib.loads(packed.read("blender_manifest.toml").decode())
        assert names == {path.name for path in paths}
        generated = manifest["build"]["generated"]  # what Blender reads of a split archive
        assert generated["platforms"] == [platform]
        assert {Path(name).name for name in generated["wheels"]} == names
        assert manifest["permissions"]["files"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(
        [*(path.name for path in built), "wheels"]
    )


def test_what_cannot_be_fetched_is_told_and_nothing_is_left(tmp_path, tools, pretend, monkeypatch):
    build_extension, _ = tools
    source = write_source(tmp_path / "pav_blender")
    (tmp_path / "out").mkdir()
    monkeypatch.delenv("PIP_FIND_LINKS")
    with pytest.raises(SystemExit, match="could not be fetched: No matching distribution") as stop:
        build_extension.build_with_wheels(tmp_path / "out", source=source, pins=pretend[0])
    assert isinstance(stop.value.code, str)  # exit code 1
    assert not list((tmp_path / "out").glob("*.zip"))


def test_a_wheel_that_is_another_than_pinned_is_refused(tmp_path, tools, pretend):
    _, wheels = tools
    pins, made = pretend
    with zipfile.ZipFile(made["linux-x64"][0], "a") as archive:
        archive.writestr("pav_pretend.py", "print('not what was pinned')")
    with pytest.raises(SystemExit, match="could not be fetched"):
        wheels.fetch(tmp_path / "cache", pins)


def test_bundled_wheels_are_those_that_blender_would_be_given(tools):
    _, wheels = tools
    text = wheels.PINS.read_text()
    assert text.count("--hash=sha256:") == 6 * 3 + 3  # safetensors is one for all Pythons
