"""Reading wide tables of signal strengths; tables are made here, of layouts in use."""

import re

import numpy as np
import pytest
import torch

import gaigs
from gaigs.data import divide
from gaigs.data.gateways import estimate_place
from gaigs.data.readings import marks_of
from gaigs.data.rssi_wide import read

PLACES = np.array([[x, y] for x in range(8) for y in range(5)]) + 0.25
GATEWAYS = {"00:cd:1a": (0.0, 0.0, 2.5), "00:cd:1b": (7.0, 4.0, 2.5), "00:cd:1c": (2.0, 4.5, 2.0)}


def levels(places=PLACES):
    """Levels at the gateways [dBm], NaN below -58; integers."""
    points = np.column_stack((places, np.ones(len(places))))
    apart = np.linalg.norm(points[:, None] - np.array([*GATEWAYS.values()]), axis=2)
    found = np.round(-40 - 27 * np.log10(apart))
    return np.where(found < -58, np.nan, found)


def table(heading=("x", "y"), mark="100", separator=",", point=".", columns=None, before=()):
    """The text of a survey: coordinates, then levels with a mark where nothing was heard."""
    rows = [separator.join((*heading, *before, *GATEWAYS))]
    for place, own in zip(PLACES if columns is None else columns, levels(), strict=True):
        cells = [
            *map(str, place),
            *before,
            *(mark if np.isnan(level) else f"{level:g}" for level in own),
        ]
        rows.append(separator.join(cell.replace(".", point) for cell in cells))
    return "\n".join(rows) + "\n"


@pytest.fixture
def survey(tmp_path):
    def write(text, **options):
        (tmp_path / "survey.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
        return read(tmp_path / "survey.csv", **options)

    return write


def heard(links):
    """Levels by place and gateway, NaN where there is no link."""
    found = np.full((len(PLACES), len(GATEWAYS)), np.nan)
    found[links.rows, links.query.receivers] = links.labels
    return found


@pytest.mark.parametrize(
    "text",
    [
        table(),
        table(mark="-200"),
        re.sub(r",-\d+", r"\g<0> dBm", table()),
        table(mark="-105"),
        table(mark=""),
        table(mark="NaN", separator="\t"),
        table(("X [m]", "Y [m]"), mark="-100").encode("utf-8-sig"),
        table(("x_pos", "y_pos"), mark="-110", separator=";", point=","),
        table(before=("Stra\xdfe",), mark="100", separator=";").encode("latin-1"),
        table(("x [cm]", "y [cm]"), columns=100 * PLACES),
        table(("easting", "northing"), columns=PLACES + np.array([691000, 5334000])),
    ],
)
def test_surveys_of_any_form_are_the_same_links(survey, text):
    links = survey(text)
    np.testing.assert_array_equal(heard(links), levels())
    assert [receiver.name for receiver in links.receivers] == [*GATEWAYS]
    first = torch.tensor(PLACES[0] - (PLACES[0] // 1 if "691000" in str(text) else 0)).float()
    torch.testing.assert_close(links.query.transmitters[0], torch.cat((first, torch.ones(1))))


def test_a_carrier_is_that_of_all_readings(survey):
    assert survey(table(), frequency=2.44e9).query.frequencies.unique().tolist() == [2.44e9]


def test_degrees_become_metres_of_utm(survey):
    pyproj = pytest.importorskip("pyproj")
    columns = np.column_stack((48.13860 + PLACES[:, 1] / 111195, 11.57360 + PLACES[:, 0] / 74260))
    links = survey(table(("lat", "lon"), columns=columns))
    assert links.frame.epsg == 32632
    corner = torch.tensor([links.frame.x, links.frame.y]) + links.query.transmitters[0, :2]
    back = pyproj.Transformer.from_crs(32632, 4326, always_xy=True).transform(
        *corner.double().tolist()
    )
    np.testing.assert_allclose(back, columns[0][::-1], atol=1e-5)
    span = links.query.transmitters.amax(0) - links.query.transmitters.amin(0)
    torch.testing.assert_close(span[:2], torch.tensor([7.0, 4.0]), atol=0.3, rtol=0)
    columns[:, 1] += 179.99995 - columns[0, 1]
    columns[columns > 180] -= 360
    links = survey(table(("lat", "lon"), columns=columns))
    span = links.query.transmitters.amax(0) - links.query.transmitters.amin(0)
    torch.testing.assert_close(span[:2], torch.tensor([7.0, 4.0]), atol=0.3, rtol=0)
    with pytest.raises(ValueError, match="expected latitudes within 90 degrees in column lat"):
        survey(table(("lon", "lat"), columns=columns + np.array([0, 100])))


def test_uji_indoor_loc_is_read_as_it_is(survey):
    extra = "LONGITUDE,LATITUDE,FLOOR,BUILDINGID,SPACEID,RELATIVEPOSITION,USERID,PHONEID,TIMESTAMP"
    rows = ["WAP001,WAP002,WAP003," + extra]
    for k, (x, y) in enumerate(PLACES):
        for shift in (0, 4):  # two phones
            own = -40 - k - shift
            place = f"{-7541.26 + x},{4864921.1 + y},{k % 2},1,106,2,{k},3,{1371713733 + k}"
            rows.append(f"{own},{-60 - k if k % 3 else 100},100,{place}")
    links = survey("\n".join(rows))
    assert [receiver.name for receiver in links.receivers] == ["WAP001", "WAP002"]
    assert links.query.transmitters[:, 2].unique().tolist() == [1, 4]
    assert links.labels[links.query.receivers == 0].tolist() == [-42 - k for k in range(40)]
    assert links.noises.unique().tolist() == pytest.approx(
        [(80 * 4 / 67) ** 0.5 / 2**0.5], rel=0.01
    )
    assert "gateways that heard nothing are left out: WAP003" in links.remarks
    assert (
        "columns ignored: BUILDINGID, SPACEID, RELATIVEPOSITION, USERID, PHONEID, TIMESTAMP"
        in links.remarks
    )


@pytest.mark.parametrize("name", ["aps.csv", "aps.yml"])
def test_places_of_gateways_come_from_a_file_or_from_training_links(survey, tmp_path, name):
    known = dict([*GATEWAYS.items()][:2])
    rows = [f"{key.upper()},{x},{y},{z}" for key, (x, y, z) in known.items()]
    yml = "".join(f'"{key}": [{x}, {y}, {z}]\n' for key, (x, y, z) in known.items())
    (tmp_path / name).write_text("MAC,x,y,z\n" + "\n".join(rows) if name.endswith("csv") else yml)
    links = survey(table(), gateways=str(tmp_path / name))
    assert [receiver.pose.position.tolist() for receiver in links.receivers[:2]] == [
        [*p] for p in known.values()
    ]
    assert links.uncertainties.tolist() == [0, 0, float("inf")]
    split = divide(links, {"name": "random"})
    place, deviation = split.receivers[2].pose.position, split.uncertainties[2].item()
    assert (place[:2] - torch.tensor([2.0, 4.5])).norm() < 1
    assert 0 < deviation < 2
    assert re.search(
        r"places of 1 receivers are estimated from the training links, .* m: 00:cd:1c \d",
        split.remarks,
    )


def test_test_links_do_not_move_a_gateway(survey, tmp_path):
    first = divide(survey(table()), {"name": "random"})
    text = (tmp_path / "survey.csv").read_text().splitlines()
    for row in first.rows[first.split.test].unique().tolist():
        text[row + 1] = re.sub(r"-\d+", "-30", text[row + 1])
    second = divide(survey("\n".join(text)), {"name": "random"})
    for a, b in zip(first.receivers, second.receivers, strict=True):
        assert torch.equal(a.pose.position, b.pose.position)


def test_links_that_calibrate_do_not_move_a_gateway(survey):
    links = divide(survey(table()), {"name": "random"})
    model = gaigs.train("path_loss", links)
    for fold, _, known in model.unseen(links):
        own = known[links.query.receivers[known] == 0]
        place, _ = estimate_place(links.query.transmitters[own], links.labels[own])
        assert torch.equal(fold.scene.receivers[0].pose.position, place)
    assert model.scene.receivers == links.scene.receivers


def test_receivers_without_training_links_are_left_out(survey):
    text = table(before=("-55",)).replace("x,y,-55", "x,y,rare").splitlines()
    links = survey(
        "\n".join([text[0], *(line.replace(",-55,", ",,", 1) for line in text[1:-1]), text[-1]])
    )
    seeds = [divide(links, {"name": "random", "seed": seed}) for seed in range(6)]
    counts = {len(links.receivers) for links in seeds}
    assert counts == {3, 4}
    (fewer, *_) = [links for links in seeds if len(links.receivers) == 3]
    assert "receivers without a training link are left out, with 1 links: rare" in fewer.remarks
    assert sorted(torch.cat([*fewer.split.parts().values()]).tolist()) == [*range(len(fewer))]


def test_an_estimated_place_is_as_far_off_as_it_says():
    draw = torch.Generator().manual_seed(0)
    errors, deviations = [], []
    for _ in range(20):
        places = torch.rand(40, 3, generator=draw) * torch.tensor([20.0, 12.0, 0.0]) + torch.tensor(
            [0, 0, 1.0]
        )
        truth = torch.rand(3, generator=draw) * torch.tensor([20.0, 12.0, 0.0]) + torch.tensor(
            [0, 0, 2.5]
        )
        apart = (places - truth).norm(dim=1)
        place, deviation = estimate_place(
            places, -40 - 28 * apart.log10() + 3 * torch.randn(40, generator=draw)
        )
        errors.append((place - truth).norm().item())
        deviations.append(deviation)
    assert np.median(errors) < 2
    assert 0.5 < np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(deviations))) < 2


def test_the_region_of_a_mast_holds_it_in_ninety_of_a_hundred_draws():
    draw = torch.Generator().manual_seed(1)
    held = 0
    for number in range(100):
        # A city, and a drone above a field; shadows are as wide as houses or trees.
        size, shadow = (
            ((2000.0, 1500.0, 0.0), 60.0) if number % 2 else ((600.0, 400.0, 130.0), 40.0)
        )
        edges = torch.tensor(size)
        places = torch.rand(150, 3, generator=draw) * edges + torch.tensor([0, 0, 1.5])
        mast = (2 * torch.rand(3, generator=draw) - 0.5) * edges
        mast[2] = 30.0
        between = 28.8 * (-torch.cdist(places, places).double() / shadow).exp()
        between.diagonal().fill_(36.0)
        white = torch.randn(150, generator=draw, dtype=torch.float64)
        slope = -30 + 8 * torch.randn(1, generator=draw)
        decades = (places - mast).norm(dim=1).clamp_min(1.0).log10()
        levels = slope * decades + torch.linalg.cholesky(between).float() @ white.float()
        place, deviation = estimate_place(places, levels)
        # 90 % of a normal region lie within 1.52 of its deviations in the plane.
        held += int((place - mast)[:2].norm() < 1.52 * deviation)
    assert 85 <= held <= 95


def test_a_mast_that_may_stand_anywhere_has_no_peak(survey):
    draw = np.random.default_rng(0)
    places = draw.uniform(0, 1000, (120, 2))
    own = -20 - 30 * np.log10(np.linalg.norm(places - [1200, 500], axis=1)) + draw.normal(0, 6, 120)
    table = np.column_stack((places, own)).round(1)
    rows = ["x,y,mast", *(",".join(map(str, row)) for row in table)]
    links = divide(survey("\n".join(rows)), {"name": "random"})
    assert links.uncertainties.min() > 50
    for name in ("path_loss", "shaped_path_loss"):
        model = gaigs.train(name, links)
        mast = links.receivers[0].pose.position
        levels = model.predict(mast + torch.tensor([[0.0, 0, 0], [20, 0, 0], [0, -20, 0]]), 0)
        assert levels.max() - levels.min() < 1
        state = model.state_dict()
        del state["regions"]  # a checkpoint of before
        model.load_state_dict(state)
        assert not model.regions.any()


def test_marks_are_found_and_levels_are_not():
    draw = np.random.default_rng(0)
    own = np.round(draw.normal(-75, 9, (100, 5))).clip(-104, -40)
    own[0, 0] = -104
    unheard = draw.random(own.shape) < 0.4
    for mark in (100, -200, 127, -110, -105, -100, 0, -1):
        assert marks_of(np.where(unheard, mark, own)) == [mark]
    assert marks_of(np.where(unheard & (np.arange(5) == 2), -120, own)) == [-120]
    own = own.clip(-88)
    constant = np.where(np.arange(5) == 2, -95, own)
    for levels in (own[own < -60][:, None], constant, np.where(constant == -95, -110, own)):
        assert marks_of(levels) == []
    own[3, 3] = -100
    assert marks_of(own) == []
    own[3, 3] = 555
    assert marks_of(own) == []


DEFECTS = [
    ("0.25,0.25,", "0.25,abc,", "line 2: expected a finite number, got 'abc' in column y"),
    ("x,y,00:cd:1a", "x,y,00:cd:1b", "line 1: expected each column once, got '00:cd:1b' 2 times"),
    (
        "x,y",
        "a,b",
        "line 1: expected columns x and y, easting and northing, or longitude and latitude",
    ),
    ("0.25,1.25,", "0.25,1.25,-515,", "line 3: expected 5 columns"),
]


@pytest.mark.parametrize(("old", "new", "message"), DEFECTS)
def test_a_defect_is_named_with_its_place(survey, old, new, message):
    text = table()
    assert old in text
    with pytest.raises(ValueError, match=re.escape(message)):
        survey(text.replace(old, new, 1))


def test_one_level_out_of_bounds_is_an_error(survey):
    text = table().splitlines()
    text[4] = re.sub(r"-\d+", "-515", text[4], count=1)
    with pytest.raises(
        ValueError,
        match=r"line 5: expected a level from -150 to 30 dBm \(100 where .* got '-515' in",
    ):
        survey("\n".join(text))
    positive = re.sub(r"(?<=,)-", "", table())
    with pytest.raises(
        ValueError, match=r"expected columns of levels .* write levels with their sign"
    ):
        survey(positive)


def test_places_of_gateways_in_yaml_have_the_units_of_the_table(survey, tmp_path):
    (tmp_path / "aps.yml").write_text(
        "".join(f'"{key}": [{100 * x}, {100 * y}]\n' for key, (x, y, _) in GATEWAYS.items())
    )
    links = survey(
        table(("x [cm]", "y [cm]"), columns=100 * PLACES),
        gateways=str(tmp_path / "aps.yml"),
        height=1.5,
    )
    expected = [[x, y, 1.5] for x, y, _ in GATEWAYS.values()]
    torch.testing.assert_close(
        torch.stack([each.pose.position for each in links.receivers]), torch.tensor(expected)
    )


def test_a_latitude_is_no_x(survey):
    with pytest.raises(ValueError, match=r"data.coordinates must have the longitude first"):
        survey(table(("lat", "lon")), coordinates=["lat", "lon"])


def test_gateways_without_a_height_are_named(survey, tmp_path):
    (tmp_path / "aps.yml").write_text('"00:cd:1a": [0.0, 0.0]\n"00:cd:1b": [7.0, 4.0, 2.5]\n')
    places = table(("x", "y", "z"), columns=np.column_stack((PLACES, np.ones(len(PLACES)))))
    remarks = survey(places, gateways=str(tmp_path / "aps.yml"), height=1.5).remarks
    assert "gateways that are 1.5 m high (data.height): 00:cd:1a" in remarks
