"""What the summary says of an object's photos, masks and clicks when something went wrong."""

import numpy as np
import pytest

from scenefuse.core.transforms import look_at
from scenefuse.mvs.undistort import largest_gap
from scenefuse.report.facts import diagnose, named
from scenefuse.report.run_summary import ObjectSummary

GOOD = {
    "sparse.not_registered": [],
    "sparse.models_left_out": [],
    "sparse.doubtful_photos": {},
    "undistorted.largest_gap_deg": 20.0,
    "undistorted.gap_between": ["a.jpg", "b.jpg"],
    "masks.photos": 40,
    "masks.photos_left_out": ["a.jpg"],
    "masks.clicks_left_out": [],
    "masks.median_agreement": 0.9,
    "alignment.found": True,
    "stage2.blurred_photos": {},
    "stage2.photo_gains": {"a.jpg": [1.2, 0.9, 1.0]},
}


def sentences(**changes):
    fields = GOOD | {name.replace("__", "."): item for name, item in changes.items()}
    stages = {name: {"value": item, "unit": ""} for name, item in fields.items()}
    return diagnose(ObjectSummary("rock", stages, {}, {}, "", "", {}))


def test_nothing_is_said_where_all_is_well_or_nothing_has_run():
    assert sentences() == []
    assert diagnose(ObjectSummary("rock", {}, {}, {}, "", "", {})) == []


def test_a_cloud_that_nothing_marks_and_that_is_refused_is_to_be_marked():
    def said(mode, status):
        fields = {"crop.mode": {"value": mode, "unit": ""}, "fine.status": {"value": status, "unit": ""}}
        return " ".join(diagnose(ObjectSummary("rock", {}, {"full": fields}, {}, "", "", {})))

    assert "column fiducials" in said("none", "unregistered")
    assert not said("none", "registered") and not said("fiducials", "unregistered")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sparse__not_registered": ["x.jpg", "y.jpg"]}, ["could not be placed (2): x.jpg, y.jpg"]),
        (
            {"sparse__not_registered": ["x.jpg", "y.jpg"], "sparse__models_left_out": [{"photos": ["y.jpg", "z.jpg"]}]},
            ["not linked to the rest (1): y.jpg;", "placed (1): x.jpg"],
        ),
        (
            {
                "sparse__not_registered": ["u.jpg", "v.jpg", "w.jpg"],
                "sparse__models_left_out": [{"photos": ["v.jpg", "w.jpg"]}, {"photos": ["u.jpg", "w.jpg"]}],
            },
            ["not linked to the rest (2): v.jpg, w.jpg; u.jpg; photograph"],
        ),
        ({"sparse__doubtful_photos": {"b.jpg": 0.6, "a.jpg": 0.7}}, ["in wrong places (2): a.jpg, b.jpg"]),
        ({"undistorted__largest_gap_deg": 190.0}, ["190 degrees without a photo, between a.jpg and b.jpg"]),
        ({"masks__photos_left_out": [f"{k}.jpg" for k in range(9)]}, ["9 of 40 masks", "and 4 more"]),
        (
            {"masks__clicks_left_out": ["the click at (3, 4) of a.jpg is 9 px off"]},
            ["left out (1): the click at (3, 4)"],
        ),
        ({"masks__median_agreement": 0.6}, ["agree by 0.60 only"]),
        ({"stage2__blurred_photos": {"b.jpg": 0.4}}, ["blurred photos (1): b.jpg"]),
        ({"stage2__photo_gains": {"a.jpg": [1, 1.1, 1], "b.jpg": [0.5, 0.5, 0.5]}}, ["others (1): b.jpg"]),
        ({"alignment__found": False, "alignment__reason": "no match"}, ["not linked with the scene's (no match)"]),
    ],
)
def test_each_cause_names_photos_and_says_what_to_do(changes, words):
    said = sentences(**changes)
    assert said and all(any(word in sentence for sentence in said) for word in words)


def test_few_photos_are_all_named():
    assert named(["a", "b"]) == "a, b"


@pytest.mark.parametrize(("seen_deg", "gap_deg"), [(330, 60), (180, 195), (90, 285)])
def test_the_widest_gap_is_where_nobody_stood(seen_deg, gap_deg):
    angles = np.radians(np.arange(0, seen_deg, 15))
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    for pose, angle in zip(poses, angles):
        eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.5]) + [7, 8, 0]
        cam_from_world = look_at(eye, [7, 8, 0.5], [0, 0, 1])
        pose[:3, :3], pose[:3, 3] = cam_from_world[:3, :3].T, eye
    found, between = largest_gap(poses, np.array([0.0, 0.0, 1.0]))
    assert abs(found - gap_deg) < 16 and set(between) == {0, len(angles) - 1}
