"""Shared fixtures of the importers' tests: FLAME-shaped models, and a source of every format."""

import shutil

import formats_fixtures as formats
import pytest


@pytest.fixture(scope="session")
def models(tmp_path_factory):
    """Folders with FLAME 2020 (and its companions) and FLAME 2023, both of the same numbers."""
    root = tmp_path_factory.mktemp("flame")
    for version, name in (("2020", "generic_model.pkl"), ("2023", "flame2023.pkl")):
        (root / version).mkdir()
        formats.write_model(root / version / name, chumpy=version == "2020")
        formats.write_companions(root / version)
    return root


@pytest.fixture(scope="session")
def heads(models):
    from pav_blender.core.head.flame import read_flame

    return {version: read_flame(models / version) for version in ("2020", "2023")}


@pytest.fixture(scope="session")
def templates(tmp_path_factory):
    """Sources written once each: {(writer, options): (folder, take)}."""
    return {}, tmp_path_factory.mktemp("templates")


@pytest.fixture
def make(templates):
    """make(writer, folder, **options): writes a source there, or a copy of one written before."""
    known, root = templates

    def write(writer, folder, **options):
        key = (writer, *sorted(options.items()))
        if key not in known:
            place = root / str(len(known))
            known[key] = place, writer(place, **options)
        shutil.copytree(known[key][0], folder)
        return known[key][1]

    return write
