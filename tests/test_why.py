"""Why pixels have no point: the picture, its colours, the shares, and `planish measure --why`."""

import itertools
import sys

import cv2
import numpy as np
import pytest

from planish.cli import main
from planish.measurement import REJECTIONS, Measurement, NoiseModel, View, rejection_bit
from planish.report.style import rgb
from planish.report.why import COLOURS, decisive_reason, rejection_shares, share_text, why_picture
from planish.rig import Rig
from sequences import phase_entries, small_rig
from synthetic import camera
from test_measure_command import write_capture

#: Full colour blindness: Machado, Oliveira & Fernandes, A physiologically-based model for simulation of color vision
#: deficiency, IEEE TVCG 15, 2009; on linear RGB.
VISION = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
#: Distance in CIE Lab at which colours are told apart at a glance: ten times the just noticeable difference of 2.3.
AT_A_GLANCE = 23.0


def seen_as(colours, matrix):
    """CIE Lab (n, 3) of sRGB colours (n, 3) in [0, 1] as people with this vision see them."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4) @ np.asarray(matrix).T
    linear = linear.clip(0, 1)
    back = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return cv2.cvtColor(back[None].astype(np.float32), cv2.COLOR_RGB2LAB)[0]


@pytest.mark.parametrize("vision", VISION)
def test_the_colours_of_all_reasons_differ_at_a_glance_for_every_colour_vision(vision):
    lab = seen_as(np.array([rgb(COLOURS[name]) for name in REJECTIONS]), VISION[vision])
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(lab, 2)) > AT_A_GLANCE


@pytest.fixture
def item():
    """A measurement with a patch of every reason."""
    device = camera(0.15)
    shape = device.size_px[::-1]
    texture = np.random.default_rng(1).uniform(50, 200, shape).astype(np.float32)
    view = View(None, texture, None, 12, NoiseModel(1.44, 0.025), 255.0)
    out = Measurement(
        "m", "A", Rig({"A": device}), np.ones((*shape, 3), np.float32), np.ones(shape, np.float32),
        np.zeros(shape, np.uint16), None, {"A": view}, ("A",), False,
    )  # fmt: skip
    for k, name in enumerate(REJECTIONS):
        out.rejected[k * 4 : k * 4 + 4, 10:30] |= rejection_bit(name)
    # What was mixed before matching is unmatched after it.
    out.rejected[60:64, 10:30] = rejection_bit("mixed") | rejection_bit("unmatched") | rejection_bit("isolated")
    out.points_sensor[out.rejected != 0] = np.nan
    return out


def test_the_decisive_reason_is_the_first_in_the_order_of_the_stages(item):
    reason = decisive_reason(item)
    assert np.all(reason[item.rejected == 0] == -1)
    for k in range(len(REJECTIONS)):
        assert np.all(reason[k * 4 : k * 4 + 4, 10:30] == k)
    assert np.all(reason[60:64, 10:30] == REJECTIONS.index("mixed"))


def test_the_shares_of_all_reasons_and_of_the_points_add_up_to_one(item):
    shares = rejection_shares(item)
    assert [*shares] == ["valid", *REJECTIONS]
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["valid"] == item.valid.mean()
    assert shares["mixed"] == pytest.approx(160 / item.rejected.size)
    assert shares["dark"] == pytest.approx(80 / item.rejected.size)


def test_the_picture_has_the_cameras_pixels_grey_where_there_is_a_point_and_a_legend_below(item):
    picture = why_picture(item)
    width, height = camera(0.15).size_px
    assert picture.shape[1] == width
    assert picture.shape[0] > height
    assert picture.dtype == np.uint8
    pixels = picture[:height]
    assert np.ptp(pixels[item.valid].astype(int), axis=1).max() == 0
    assert pixels[item.valid].std() > 10
    for k, name in enumerate(REJECTIONS):
        assert np.all(pixels[k * 4 : k * 4 + 4, 10:30] == np.rint(rgb(COLOURS[name]) * 255))
        swatch = (picture[height:] == np.rint(rgb(COLOURS[name]) * 255)).all(-1)
        assert swatch.sum() > 50


def test_a_small_share_is_not_rounded_away():
    assert [share_text(s) for s in (0.0, 1e-6, 0.00512, 1.0)] == ["0 %", "< 0.01 %", "0.51 %", "100.00 %"]


def test_measure_writes_the_picture_and_prints_the_shares(tmp_path, monkeypatch, capsys):
    write_capture(tmp_path / "part", small_rig(), phase_entries([320, 40]))
    monkeypatch.setattr(sys, "argv", ["planish", "measure", str(tmp_path / "part"), "--out", str(tmp_path), "--why"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert not stop.value.code
    lines = capsys.readouterr().out.splitlines()
    m = Measurement.load(tmp_path / "part.h5")
    shares = lines[-len(REJECTIONS) - 1 :]
    assert [line.split()[0] for line in shares] == ["valid", *REJECTIONS]
    assert f"{100 * m.valid.mean():.2f} %" in shares[0]
    image = cv2.imread(str(tmp_path / "part_why.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert np.array_equal(image, why_picture(m))
