"""Metrics against well-kept libraries, published values and what is known in closed form."""

import math
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg, signal

from pav_blender.core.errors import InputError
from pav_blender.core.evaluation import learned
from pav_blender.core.evaluation.metrics import SSIM_WINDOW, fog, frechet, holes, psnr, ssim


@pytest.fixture(scope="module")
def photo():
    """A colour photograph in [0, 1], [160, 160, 3]."""
    from skimage import data

    return data.astronaut()[40:200, 150:310] / 255


def noisy(picture, deviation, seed=0):
    noise = np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(picture + deviation * noise, 0, 1)


def test_psnr_is_scikit_images_and_the_masks_own(photo):
    from skimage.metrics import peak_signal_noise_ratio

    other = noisy(photo, 0.1)
    assert psnr(other, photo) == pytest.approx(peak_signal_noise_ratio(photo, other, data_range=1))
    assert psnr(photo + 0.1, photo) == pytest.approx(20)
    mask = np.zeros(photo.shape[:2], bool)
    mask[20:40] = True
    assert psnr(other, photo, mask) == pytest.approx(psnr(other[20:40], photo[20:40]))
    assert math.isnan(psnr(other, photo, np.zeros_like(mask)))


def test_ssim_is_near_what_imdiff_published():
    """0.35796 by IPOL's imdiff for this picture and noise (scikit-image's own tests quote it)."""
    from skimage import data

    grey = data.camera()
    noise = np.random.RandomState(5).randn(*grey.shape)
    other = np.clip(grey + 20.0 * noise, 0, 255).astype(np.uint8)
    colour = [np.repeat(one[..., None] / 255, 3, axis=2) for one in (other, grey)]
    assert ssim(*colour) == pytest.approx(0.357959, abs=1e-3)


def test_ssim_is_the_papers_formula_a_channel_with_a_window_of_11(photo):
    small, other = photo[:40, :50], noisy(photo[:40, :50], 0.08)
    at = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(at**2) / (2 * 1.5**2))
    window = np.outer(window, window) / window.sum() ** 2

    def blurred(values):
        return signal.convolve2d(values, window, mode="valid")

    channels = []
    for c in range(3):
        x, y = small[..., c], other[..., c]
        mx, my = blurred(x), blurred(y)
        vx, vy, xy = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
        near = (2 * mx * my + 0.01**2) * (2 * xy + 0.03**2)
        channels.append((near / ((mx**2 + my**2 + 0.01**2) * (vx + vy + 0.03**2))).mean())
    assert ssim(other, small) == pytest.approx(np.mean(channels), abs=1e-6)
    assert ssim(small, small) == 1


def test_fog_and_holes_are_counted_far_from_the_mattes_edge():
    y, x = np.mgrid[:100, :100]
    radius = np.hypot(x - 50, y - 50)
    matte = (255 * (radius < 30)).astype(np.uint8)
    opacity = np.where(radius < 30, 1.0, 0.0)
    assert fog(opacity, matte) == holes(opacity, matte) == 0
    ragged = np.where(np.abs(radius - 30) < 1.5, 0.5, opacity)  # an edge that is a bit off
    assert fog(ragged, matte) == holes(ragged, matte) == 0
    assert fog(np.where(radius > 31, 0.25, opacity), matte) == pytest.approx(0.25)
    assert holes(np.where(radius < 29, 0.9, opacity), matte) == pytest.approx(0.1)
    floater = opacity.copy()
    floater[0:10, 0:10] = 1
    outside = (radius > 32).sum()
    assert fog(floater, matte) == pytest.approx(100 / outside, rel=0.03)
    assert holes(floater, matte) == 0
    nobody = np.zeros_like(matte)
    assert fog(np.full(matte.shape, 0.5), nobody) == pytest.approx(0.5)
    assert math.isnan(holes(opacity, nobody))


def gaussian(mean, covariance, count, seed):
    """[count, D] samples that have just this mean and covariance."""
    samples = np.random.default_rng(seed).standard_normal((count, len(mean)))
    samples -= samples.mean(0)
    samples = samples @ linalg.inv(linalg.sqrtm(np.cov(samples, rowvar=False))).real
    return samples @ linalg.sqrtm(covariance).real + mean


def test_frechet_distance_of_gaussians_in_closed_form():
    a, b = np.array([1.0, 4.0, 9.0]), np.array([4.0, 1.0, 0.25])
    apart = np.array([1.0, -2.0, 0.5])
    ours = gaussian(apart, np.diag(a), 40, 0)
    truth = gaussian(np.zeros(3), np.diag(b), 70, 1)
    wanted = (apart**2).sum() + ((np.sqrt(a) - np.sqrt(b)) ** 2).sum()
    assert frechet(ours, truth) == pytest.approx(wanted)
    # covariances that do not commute
    turn = linalg.expm(np.array([[0, 0.5, 0.2], [-0.5, 0, 0.7], [-0.2, -0.7, 0]]))
    turned = turn @ np.diag(a) @ turn.T
    wanted = np.trace(turned + np.diag(b) - 2 * linalg.sqrtm(turned @ np.diag(b)).real)
    assert frechet(gaussian(np.zeros(3), turned, 40, 2), truth) == pytest.approx(wanted)


def test_frechet_distance_of_fewer_pictures_than_features():
    features = np.random.default_rng(0).standard_normal((5, 64))
    assert frechet(features, features[::-1]) == pytest.approx(0, abs=1e-9)
    assert frechet(features + 0.5, features) == pytest.approx(64 * 0.25)
    assert frechet(2 * features, 2 * features.mean(0) + 0 * features) == pytest.approx(
        4 * features.var(0, ddof=1).sum()
    )


def test_st_lpips_is_none_for_equal_pictures_grows_and_bears_a_shift(photo):
    pytest.importorskip("stlpips_pytorch", reason="stlpips-pytorch is not installed")
    compare = learned.st_lpips()
    picture, shifted = photo[:128, :128], photo[:128, 1:129]
    assert compare(picture, picture) == 0
    values = [compare(noisy(picture, s), picture) for s in (0.02, 0.05, 0.1, 0.2)]
    assert values == sorted(values)
    assert values[0] > 0
    # a shift that costs more PSNR than noise does costs far less of this metric
    assert psnr(shifted, picture) < psnr(noisy(picture, 0.05), picture)
    assert compare(shifted, picture) < 0.1 * values[1]
    assert not {"IPython", "torchsummary"} & sys.modules.keys()


@pytest.fixture
def offline(tmp_path, monkeypatch):
    """An empty hub cache, and no way to fetch anything."""
    import torch

    def refuse(*_, **__):
        raise AssertionError("something is being downloaded")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    return tmp_path


@pytest.mark.parametrize("load", [learned.lpips, learned.dists, learned.inception])
def test_a_metric_that_lacks_something_is_absent_and_nothing_is_fetched(load, offline, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    with pytest.raises(learned.Absent) as absent:
        load(offline)
    assert absent.value.reason == "weights absent"
    assert str(offline) in absent.value.needs
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name != "torchvision" or None)
    with pytest.raises(learned.Absent) as absent:
        load(offline)
    assert (absent.value.reason, absent.value.needs) == (
        "package absent",
        "pip install torchvision",
    )


def test_a_package_that_is_not_there_is_absent(monkeypatch):
    for name in ("stlpips_pytorch", "stlpips_pytorch.stlpips"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(learned.Absent) as absent:
        learned.st_lpips()
    assert absent.value.reason == "package absent"


@pytest.mark.parametrize(
    ("fails", "why"),
    [
        ("raise RuntimeError('operator torchvision::nms does not exist\\nat line 5')",
         "torchvision: operator torchvision::nms does not exist"),
        ("import torch; torch.library.no_such_thing",
         "torchvision: module 'torch.library' has no attribute 'no_such_thing'"),
        ("raise OSError('libcudart.so.13: cannot open shared object file')",
         "torchvision: libcudart.so.13: cannot open shared object file"),
    ],
)  # fmt: skip
def test_a_package_that_does_not_load_is_not_called_absent(fails, why, offline, monkeypatch):
    """As PyPI's torchvision beside another torch: with the weights at hand."""
    (offline / "torchvision").mkdir()
    (offline / "torchvision" / "__init__.py").write_text(fails)
    monkeypatch.syspath_prepend(str(offline))
    for name in [n for n in sys.modules if n.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    monkeypatch.setattr(learned, "read", lambda file, path: {})
    (offline / learned.ALEXNET.name).write_bytes(b"")
    with pytest.raises(learned.Absent) as absent:
        learned.lpips(offline)
    assert (absent.value.reason, absent.value.needs) == ("package does not load", why)


def test_weights_are_found_and_others_refused(offline):
    (offline / "hub" / "checkpoints").mkdir(parents=True)
    cached = offline / "hub" / "checkpoints" / learned.ALEXNET.name
    cached.write_bytes(b"not these")
    assert learned.find(learned.ALEXNET, None) == cached
    given = offline / "checkpoints" / learned.ALEXNET.name
    given.parent.mkdir()
    given.write_bytes(b"nor these")
    assert learned.find(learned.ALEXNET, offline) == given
    with pytest.raises(InputError, match="not 7be5be79"):
        learned.read(learned.ALEXNET, given)


WIRED = """
import dataclasses, hashlib, sys
from pathlib import Path
import numpy as np
import torch
try:
    import torchvision
except RuntimeError:  # built for another torch: only these two operators are missed at import
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    import torchvision
from torchvision import models
from pav_blender.core.evaluation import learned

folder = Path(sys.argv[1])
torch.manual_seed(0)
for name in ("ALEXNET", "VGG16"):
    file = getattr(learned, name)
    with torch.device("meta"):
        known = getattr(models, name.lower())().state_dict()
    state = {k: torch.zeros(v.shape) for k, v in known.items() if k.startswith("features")}
    for value in state.values():
        if value.dim() == 4:
            torch.nn.init.kaiming_normal_(value)
    torch.save(state, folder / file.name)
    digest = hashlib.sha256((folder / file.name).read_bytes()).hexdigest()[:8]
    setattr(learned, name, dataclasses.replace(file, digest=digest))
random = np.random.default_rng(0)
picture = random.random((48, 48, 3))
other = [np.clip(picture + s * random.standard_normal(picture.shape), 0, 1) for s in (0.05, 0.3)]
for load in (learned.lpips, learned.dists):
    compare = load(folder)
    values = [compare(picture, picture), compare(other[0], picture), compare(other[1], picture)]
    assert abs(values[0]) < 1e-6 and 1e-5 < values[1] < values[2] < 1, values
    print(load.__name__, values)
"""


def test_lpips_and_dists_take_the_networks_in_the_files(tmp_path):
    """With the packages' own code and networks of random weights: these are not downloaded."""
    for name in ("lpips", "DISTS_pytorch", "torchvision"):
        if find_spec(name) is None:
            pytest.skip(f"{name} is not installed")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WIRED, tmp_path],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stderr
    assert "lpips" in done.stdout
    assert "dists" in done.stdout
