# SPDX-License-Identifier: Apache-2.0
"""Page of a plan: sections, needle, numbers, orientations of the image, and invalid plans."""

from __future__ import annotations

import asyncio
import base64
from dataclasses import replace
from itertools import combinations, permutations, product
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from needle_dynamics import FloatArray
from needle_insertion.cli import main
from needle_insertion.report import plan_page
from needle_insertion.report.anatomy_view import AnatomyView
from needle_insertion.report.section import directions, legend_of, Plane, sample, section
from needle_planning import Anatomy, Chance, chance_of, find_plan, Plan, read_anatomy, Structure
from needle_planning.clearance import Clearance
from needle_ros.errors import ParameterError
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.anatomies import affine
from support.pages import look_at
from tools.browser import BROWSER, browser

LIVER = Path(__file__).parents[2] / 'examples' / 'liver'
FILES = (LIVER / 'liver.seg.nrrd', LIVER / 'labels.yaml')
RADIUS = 6e-4


def small(turn: FloatArray | None = None) -> Anatomy:
    """Return skin, tissue and a bone; names are not formulas, tags or Latin letters only."""
    labels = np.zeros((60, 52, 80), dtype=np.int16)
    labels[:, :, 5:79], labels[:, :, 78], labels[10:34, :, 50:53] = 3, 1, 2
    return Anatomy(
        labels=labels,
        to_patient=affine([1e-3, 1.1e-3, 1.2e-3], turn, [0.013, -0.021, 0.007]),
        structures={
            1: Structure(name='皮膚', role='entry'),
            2: Structure(name='_bone $<1', role='obstacle', margin=2e-3),
            3: Structure(name='muscle', role='tissue'),
        },
    )


def turned(anatomy: Anatomy, order: tuple[int, ...], signs: tuple[int, ...]) -> Anatomy:
    """Return the same anatomy with its voxels in another order."""
    matrix = anatomy.to_patient[:, [*order, 3]].copy()
    labels = anatomy.labels.transpose(order)
    for axis in np.flatnonzero(np.array(signs) < 0).tolist():
        matrix[:, 3] += (labels.shape[axis] - 1) * matrix[:, axis]
        matrix[:, axis] *= -1.0
        labels = np.flip(labels, axis)
    return replace(anatomy, labels=labels, to_patient=matrix)


ORIENTATIONS = list(product(permutations(range(3)), product((1, -1), repeat=3)))


@pytest.fixture(scope='module')
def straight() -> Plan:
    # Not at the boundary of a voxel in any section.
    turn = Rotation.from_rotvec([0.21, -0.13, 0.34]).as_matrix()
    anatomy = small(turn)
    target = anatomy.to_patient @ [30.31, 26.17, 11.23, 1.0]
    return find_plan(anatomy, target[:3], bow=False, resolution=2e-3)


@pytest.fixture(scope='module')
def anatomy() -> Anatomy:
    return small(Rotation.from_rotvec([0.21, -0.13, 0.34]).as_matrix())


@pytest.fixture(scope='module')
def bowed() -> Plan:
    entry = (0.132, 0.037, -0.001)
    return find_plan(read_anatomy(*FILES), (0.062, 0.012, 0.01), entry=entry, entry_radius=3e-3)


@pytest.fixture(scope='module')
def chance(straight: Plan, anatomy: Anatomy) -> Chance:
    return chance_of(straight, anatomy, insertions=16, seed=3, workers=1, shafts=12)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6))
def test_section_of_a_box_is_its_analytical_outline(seed: int) -> None:
    """Structure and margin at each pixel, for oblique images and planes."""
    rng = np.random.default_rng(seed)
    spacing, axes = rng.uniform(5e-4, 4e-3, 3), Rotation.random(random_state=seed).as_matrix()
    labels = np.zeros(rng.integers(6, 14, 3), dtype=np.int16)
    low = rng.integers(0, 4, 3)
    high = low + rng.integers(1, np.array(labels.shape) - low + 1)
    labels[tuple(map(slice, low, high))] = 7
    margin = float(rng.uniform(0.0, 5e-3))
    box = Anatomy(
        labels=labels,
        to_patient=affine(spacing, axes, rng.normal(0.0, 0.1, 3)),
        structures={7: Structure(name='box', role='obstacle', margin=margin)},
    )
    middle = box.to_patient @ np.append(0.5 * (low + high) - 0.5, 1.0)
    across = Rotation.random(random_state=seed + 1).as_matrix()[:2]
    plane = Plane(
        middle[:3] + rng.normal(0.0, 2e-3, 3), across, np.array([-0.03, -0.02]),
        np.array([0.03, 0.02]), 5e-4,
    )  # fmt: skip
    legend = legend_of([box])
    clearance = Clearance([box], plane.corners, radius=RADIUS)
    found = section([box], legend, clearance, RADIUS, plane)
    beyond = np.abs((plane.points - middle[:3]) @ axes) - 0.5 * (high - low) * spacing
    inside = beyond.max(axis=-1)
    distance = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    # A micrometer: rounding of the frame of the image.
    sure = np.abs(inside) > 1e-6
    assert np.array_equal((found.numbers == 0)[sure], (inside < 0.0)[sure])
    near = (inside > 0.0) & (distance < margin)
    sure &= np.abs(distance - margin) > 1e-6
    assert np.array_equal(found.margin[sure], near[sure])


def test_obstacles_cover_targets_entries_and_tissue() -> None:
    """Also in images with different grids; outside of all images the number is -2."""

    def image(role: str, size: int, value: int) -> Anatomy:
        labels = np.full((size, size, size), value, dtype=np.uint8)
        return Anatomy(
            labels=labels,
            to_patient=affine([1e-3] * 3),
            structures={} if not value else {value: Structure(name=role, role=role)},
        )

    images = [
        image('tissue', 10, 4), image('obstacle', 2, 9), image('entry', 8, 1),
        image('target', 4, 1), image('tissue', 12, 0),
    ]  # fmt: skip
    legend = legend_of(images)
    along = np.array([1.0, 3.0, 6.0, 9.0, 11.0, 13.0])[:, np.newaxis] * [1e-3, 0.0, 0.0]
    for some in (images, images[::-1]):
        assert sample(some, legend.structures, along).tolist() == [0, 1, 2, 3, -1, -2]


@pytest.mark.parametrize(
    ('vector', 'letters'),
    [((1, 0, 0), 'R'), ((-1, 0, 0), 'L'), ((0, 1, 0), 'A'), ((0, 0, -1), 'I'),
     ((-0.8, -0.6, 0), 'LP'), ((0.1, 0.5, 0.86), 'SA')],
)  # fmt: skip
def test_patient_directions(vector: tuple[float, ...], letters: str) -> None:
    assert directions(np.array(vector)) == letters


def test_orientations_give_the_same_sections(straight: Plan, anatomy: Anatomy) -> None:
    legend = legend_of([anatomy], straight.structure)
    planes = plan_page._planes(straight, legend)
    expected = [sample([anatomy], legend.structures, one.points) for one in planes]
    assert {0, 1, 2} <= set(np.unique(expected[0]))
    for order, signs in ORIENTATIONS:
        other = turned(anatomy, order, signs)
        for one, numbers in zip(planes, expected, strict=True):
            assert np.array_equal(sample([other], legend.structures, one.points), numbers)


def test_orientations_give_the_same_page(
    straight: Plan, anatomy: Anatomy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv('SOURCE_DATE_EPOCH', '0')
    pages = set()
    for number in (0, 21, 47):
        plan_page.write_plan_page(straight, turned(anatomy, *ORIENTATIONS[number]), tmp_path / 'a')
        pages.add((tmp_path / 'a').read_bytes())
    assert len(pages) == 1


def test_needle_is_drawn_where_the_plan_has_it(straight: Plan, anatomy: Anatomy) -> None:
    """The shaft is black from the skin to the target, in pictures with a true aspect ratio."""
    legend = legend_of([anatomy], straight.structure)
    planes = plan_page._planes(straight, legend)
    for one, end in zip(planes[:2], ('x', 'z'), strict=True):
        np.testing.assert_allclose(one.coordinates(straight.entry), 0.0, atol=1e-12)
        # Rounding of the direction.
        at = one.coordinates(straight.target)
        np.testing.assert_allclose(at, [straight.length, 0.0], atol=1e-9)
        # Both planes contain the target.
        np.testing.assert_allclose(one.origin + at @ one.axes, straight.target, atol=1e-9)
        clearance = Clearance([anatomy], one.corners, radius=straight.radius)
        shaft = plan_page._shaft(straight, clearance)
        shown = section([anatomy], legend, clearance, straight.radius, one)
        figure = plan_page._picture(straight, legend, shaft, f'plan_{end}', shown).figure
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = np.asarray(canvas.buffer_rgba())[::-1, :, :3]
        to_pixels = figure.axes[0].transData.transform
        zero, right, up = to_pixels([(0.0, 0.0), (10.0, 0.0), (0.0, 10.0)])
        # Less than a pixel.
        assert right[0] - zero[0] == pytest.approx(up[1] - zero[1], abs=0.5)
        depths = np.linspace(-2.0, 1e3 * straight.length - 4.0, 30)
        for side, dark in ((0.0, True), (0.8, True), (6.0, False), (-6.0, False)):
            across = np.full(30, side if abs(side) > 1.0 else 1e3 * side * straight.radius)
            x, y = to_pixels(np.stack([depths, across], axis=1)).astype(int).T
            # The circle and the mark of the entry point are also black; labels and edges not.
            assert (np.mean((image[y, x] < 60).all(axis=1)) > 0.95) == dark


@pytest.mark.parametrize('name', ['x', 'bowed structure with a very long name, number 12'])
def test_labels_do_not_overlap(bowed: Plan, name: str) -> None:
    """Also those of the legend and the axes, with structures of short and of long names."""
    images = read_anatomy(*FILES)
    renamed = [
        replace(
            one,
            structures={
                label: replace(each, name=f'{name} {each.name}')
                for label, each in one.structures.items()
            },
        )
        for one in images
    ]
    legend = legend_of(renamed, f'{name} {bowed.structure}')
    planes = plan_page._planes(bowed, legend)
    corners = np.concatenate([one.corners for one in planes])
    clearance = Clearance(renamed, corners, radius=bowed.radius)
    shaft = plan_page._shaft(bowed, clearance)
    pictures = [
        plan_page._picture(
            bowed, legend, shaft, f'plan_{end}',
            section(renamed, legend, clearance, bowed.radius, one),
        )
        for end, one in zip(('x', 'z', 'across'), planes, strict=True)
    ]  # fmt: skip
    for picture in [*pictures, plan_page._by_depth(bowed, legend, shaft)]:
        figure = picture.figure
        FigureCanvasAgg(figure).draw()
        shown = [text for axes in figure.axes for text in axes.texts]
        boxes = [text.get_window_extent() for text in shown]
        assert all(figure.axes[0].bbox.containsx(box.x0) for box in boxes)
        legends = [one.get_window_extent() for one in figure.legends]
        for axes in figure.axes:
            labels = axes.xaxis.label, axes.yaxis.label
            boxes += [one.get_window_extent() for one in labels if one.get_text()]
            assert not any(axes.bbox.overlaps(one) for one in legends)
        boxes += legends
        for one, other in combinations(boxes, 2):
            assert not one.overlaps(other)
        for box in boxes:
            assert figure.bbox.x0 <= box.x0 <= box.x1 <= figure.bbox.x1
            assert figure.bbox.y0 <= box.y0 <= box.y1 <= figure.bbox.y1


def test_section_across_is_at_the_least_clearance(bowed: Plan) -> None:
    across = plan_page._planes(bowed, legend_of(read_anatomy(*FILES), bowed.structure))[2]
    normal = np.cross(*across.axes)
    # Rounding of the direction.
    np.testing.assert_allclose(np.abs(normal @ bowed.direction), 1.0, atol=1e-9)
    assert abs((bowed.place - across.origin) @ normal) < 1e-9
    assert (np.abs(across.coordinates(bowed.place)) < across.high).all()


def test_page_has_all_numbers_of_the_plan(bowed: Plan, tmp_path: Path) -> None:
    file = tmp_path / 'plan.html'
    plan_page.write_plan_page(bowed, read_anatomy(*FILES), file)
    seen = look_at(file)
    lengths = [
        *bowed.entry, *bowed.target, *bowed.place, *bowed.depths, *bowed.guide.ravel(),
        *bowed.path.ravel(), *bowed.clearances, bowed.radius, bowed.length, bowed.clearance,
        bowed.bow, bowed.resolution, bowed.straight_bound, bowed.bound,
    ]  # fmt: skip
    expected = [f'{1e3 * one + 0.0:.2f}' for one in lengths]
    expected += [f'{one:.4f}' for one in bowed.direction]
    for text in [*expected, bowed.needle, f'{np.degrees(bowed.roll):.2f} deg', bowed.structure]:
        assert text.replace('-0.00', '0.00') in seen.text
    for anatomy in read_anatomy(*FILES):
        assert all(one.name in seen.text for one in anatomy.structures.values())
    assert 'needle_insertion ' in seen.text
    assert seen.requests == []
    assert seen.overflow <= 0
    assert len(seen.images) == 4
    assert all(words and width > 0 for words, width in seen.images)


def test_view_has_surfaces_needle_and_insertions(
    straight: Plan, anatomy: Anatomy, chance: Chance
) -> None:
    content = AnatomyView('', straight, [anatomy], chance).content
    middle = 5e2 * (straight.entry + straight.target)
    assert [one['name'] for one in content['structures']] == ['皮膚', '_bone $<1', 'muscle']
    for one in content['structures']:
        values = np.frombuffer(base64.b64decode(one['points']), '<i2').reshape(-1, 3)
        triangles = np.frombuffer(base64.b64decode(one['triangles']), '<u2')
        assert triangles.max() < len(values)
        points = 1e-3 * (content['unit'] * values + middle)
        (label,) = (k for k, named in anatomy.structures.items() if named.name == one['name'])
        index = np.argwhere(anatomy.labels == label)
        found = (points - anatomy.to_patient[:3, 3]) @ np.linalg.inv(anatomy.to_patient[:3, :3]).T
        # Half a voxel, rounded edges, and merged points.
        np.testing.assert_allclose(found.min(axis=0), index.min(axis=0) - 0.5, atol=0.5)
        np.testing.assert_allclose(found.max(axis=0), index.max(axis=0) + 0.5, atol=0.5)
    needle = content['needle']
    # Rounded to 0.01 mm; the needle of the page ends at the target to 0.2 mm.
    np.testing.assert_allclose(needle['points'][-1], 1e3 * straight.target, atol=0.2)
    # The points drawn are up to 1 mm from the least clearance, which changes as the distance.
    assert min(needle['clearance']) == pytest.approx(1e3 * straight.clearance, abs=1.0)
    ends = [one['points'][-1] for one in content['inserted']]
    tips = 1e3 * np.stack([chance.values[f'tip_{axis}'][:12] for axis in 'ras'], axis=1)
    np.testing.assert_allclose(ends, tips, atol=0.0051)
    success = [one['success'] for one in content['inserted']]
    assert success == (chance.values['success'][:12] > 0).tolist()


@pytest.mark.skipif(BROWSER is None, reason='no Chromium on this machine')
def test_anatomy_turns_in_a_browser(
    straight: Plan, anatomy: Anatomy, chance: Chance, tmp_path: Path
) -> None:
    """Keys, buttons and choices draw another picture, and nothing is loaded or too wide."""
    path = tmp_path / 'plan.html'
    plan_page.write_plan_page(straight, anatomy, path, chance)
    # Surfaces and script; the pictures are half a megabyte.
    assert path.stat().st_size < 2e6

    async def look() -> None:
        async with browser() as tab:
            await tab.size(400, 900)
            await tab.open(path.as_uri())
            drawn = "Number(document.querySelector('.solid').dataset.drawn || 0)"
            await tab.wait(f'{drawn} > 0', 'the first picture')
            pixels = (
                "(() => { const one = document.querySelector('.stage canvas'); "
                "const made = document.createElement('canvas'), pen = made.getContext('2d'); "
                'Object.assign(made, {width: one.width, height: one.height}); '
                'needleAnatomyView.draw(); pen.drawImage(one, 0, 0); return made.toDataURL() })()'
            )
            canvas = "document.querySelector('.stage canvas')"
            pictures = [await tab.run(pixels)]
            for action in (
                "document.querySelectorAll('.solid button')[4].click()",
                "document.querySelectorAll('.solid button')[5].click()",
                "document.querySelectorAll('.solid input')[1].click()",
                f'{canvas}.dispatchEvent(new KeyboardEvent("keydown", {{key: "ArrowLeft"}}))',
            ):
                await tab.run(action)
                pictures.append(await tab.run(pixels))
            assert len(set(pictures)) == len(pictures)
            names = await tab.run("document.querySelector('.solid').innerText")
            assert 'inserted, failure' in names
            assert '_bone $<1 (obstacle)' in names
            wide = 'document.documentElement.scrollWidth - document.documentElement.clientWidth'
            assert await tab.run(wide) == 0
            await tab.call('Emulation.setEmulatedMedia', media='print')
            assert await tab.run("document.querySelector('.solid').clientHeight") == 0
            assert tab.faults == []

    asyncio.run(look())


def test_command_writes_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the command in its last line; the page is of the plan that is printed."""
    file = tmp_path / 'plan.html'
    words = ['plan', str(FILES[0]), '--labels', str(FILES[1]), '--target', '62mm,12mm,10mm']
    some = ['--straight', '--resolution', '2mm', '--insertions', '3', '--page', str(file)]
    assert main([*words, *some]) == 0
    text = capsys.readouterr().out
    assert text.endswith(f'wrote {file}\n')
    seen = look_at(file).text
    assert '3 of 3 simulated insertions' in seen
    assert 'no contact along the needle' in seen
    assert 'needle plan ' in seen
    entry = next(line.split()[1:] for line in text.splitlines() if line.startswith('entry '))
    assert all(one in seen for one in entry)


def test_clearance_at_the_limit_has_no_bound(
    straight: Plan, anatomy: Anatomy, tmp_path: Path
) -> None:
    """Larger clearances are not searched."""
    far = replace(
        anatomy, structures={**anatomy.structures, 2: Structure(name='muscle 2', role='tissue')}
    )
    plan = find_plan(far, straight.target, bow=False)
    for one, image, at_limit in ((plan, far, True), (straight, anatomy, False)):
        plan_page.write_plan_page(one, image, tmp_path / 'plan.html')
        seen = look_at(tmp_path / 'plan.html').text
        assert ('at least 30.00 mm' in seen) == at_limit
        assert ('limit of the search, a straight needle may have more' in seen) == at_limit
        assert ('no straight needle has more' in seen) != at_limit


def test_pages_of_a_folder_have_their_own_pictures(
    straight: Plan, anatomy: Anatomy, tmp_path: Path
) -> None:
    """The pictures of the first page remain."""
    names = 'across', 'depth', 'x', 'z'
    plan_page.write_plan_page(straight, anatomy, tmp_path / 'plan.html')
    assert sorted(one.stem for one in tmp_path.glob('*.png')) == [f'plan_{one}' for one in names]
    before = {one: one.read_bytes() for one in tmp_path.iterdir()}
    plan_page.write_plan_page(replace(straight, roll=0.1), anatomy, tmp_path / 'other.html')
    added = sorted(one.stem for one in {*tmp_path.glob('*.png')} - before.keys())
    assert added == [f'other_{one}' for one in names]
    assert all(one.read_bytes() == content for one, content in before.items())


def test_names_are_shown_as_they_are(straight: Plan, anatomy: Anatomy, tmp_path: Path) -> None:
    plan_page.write_plan_page(straight, anatomy, tmp_path / 'plan.html')
    seen = look_at(tmp_path / 'plan.html').text
    assert '_bone $<1' in seen
    assert '皮膚' in seen
    # The font of the pictures has no such characters: a number of the table.
    assert legend_of([anatomy]).names == ['_bone $<1', 'structure 2', 'muscle']


def test_plan_that_does_not_fit_is_one_line(
    straight: Plan, anatomy: Anatomy, tmp_path: Path
) -> None:
    file = tmp_path / 'plan.html'
    away = replace(
        straight, entry=straight.entry + 1.0, target=straight.target + 1.0,
        place=straight.place + 1.0,
    )  # fmt: skip
    others = {**anatomy.structures, 2: replace(anatomy.structures[2], margin=6e-3)}
    for plan, image, message in (
        (away, anatomy, 'is outside the image'),
        (straight, replace(anatomy, structures=others), 'the plan is of another anatomy: it has'),
        (replace(straight, path=straight.path + 1e-3), anatomy, 'is not the one of the plan'),
        (replace(straight, needle='none'), anatomy, 'needle must be one of'),
    ):
        with pytest.raises(ParameterError, match=message) as error:
            plan_page.write_plan_page(plan, image, file)
        assert len(str(error.value).splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
