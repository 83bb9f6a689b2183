"""The completed scene on hand-made clouds: what each object adds, what is taken away, who is named."""

from dataclasses import replace

import laspy
import numpy as np
import pytest

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.core.job_records import JobRecords
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.core.version import VERSION
from scenefuse.fuse.fuse_object import FusionInputs, FusionOutputs, fuse_object
from scenefuse.fuse.modes import FusionSettings, fuse_by_distance
from scenefuse.fuse.write import CompletionInputs, complete_scene, without_overlaps

SETTINGS = FusionSettings(mode="fill")
POSE = Sim3(2.0, np.eye(3), np.array([1.0, 2.0, 3.0]))


def strip(low, high, y=0.0, color=(200, 100, 50)):
    """A flat grid, x from low to high, 2 wide from y on, 0.1 apart."""
    x, y = np.meshgrid(np.arange(low, high, 0.1), np.arange(y, y + 2, 0.1))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    return Cloud(points, normals, (np.array(color) * (0.6 + 0.4 * np.sin(points[:, :1]))).astype(np.uint8))


def run(folder, scene, objects, mode="fill", refused=(), failed=(), georeference=None):
    """Each object fused, then the stage, on objects given in the scene's frame; each one's crop is the scene itself."""
    write_cloud(folder / "scene.ply", scene)
    write_json(
        folder / "crop.json",
        {
            "level_from_scene": quantity(np.eye(3), ""),
            "box_low": quantity([-1, -1, -1], ""),
            "box_high": quantity([30, 9, 1], ""),
        },
    )
    for name, cloud in objects.items():
        mine = folder / name
        write_cloud(mine / "object.ply", cloud.transformed(POSE.inverse()))
        status = "unregistered" if name in refused else "registered"
        fine = {"status": quantity(status, ""), "reason": quantity("weak", "")}
        write_json(mine / "fine.json", fine | {"scene_from_object": quantity(POSE.matrix, "")})
        fuse_object(
            inputs=FusionInputs(
                object=mine / "object.ply",
                scene=folder / "scene.ply",
                crop=folder / "scene.ply",
                crop_json=folder / "crop.json",
                fine_json=mine / "fine.json",
                georeference_json=georeference,
            ),
            outputs=FusionOutputs(
                fused=mine / "fused.ply",
                checked=mine / "checked.ply",
                evidence=mine / "evidence.json",
                report=mine / "fusion.json",
            ),
            settings=replace(SETTINGS, mode=mode),
        )
    complete_scene(
        inputs=CompletionInputs(
            scene=folder / "scene.ply",
            objects=[folder / name for name in (*objects, *(f for f in failed if f not in objects))],
            failed=tuple(failed),
            jobs=JobRecords(folder / "logs", folder / "benchmarks"),
            georeference_json=georeference,
        ),
        completed=folder / "completed.ply",
        completed_copc=folder / "completed.copc.laz",
        report=folder / "completed.json",
    )
    return read_cloud(folder / "completed.ply"), read_json(folder / "completed.json")


def test_objects_apart_add_what_each_adds_alone(tmp_path):
    scene, objects = strip(0, 20), {"left": strip(0.03, 3, 1.54), "right": strip(10.03, 13, 1.54, (90, 90, 90))}
    whole, report = run(tmp_path, scene, objects)
    assert value(report, "sources") == {"0": "scene", "1": "left", "2": "right"}
    assert np.array_equal(whole.points[whole.fields["source"] == 0], scene.points)
    for number, (name, cloud) in enumerate(objects.items(), 1):
        alone = fuse_by_distance(cloud.transformed(POSE.inverse()), scene, scene, POSE, SETTINGS).added
        mine = whole[whole.fields["source"] == number]
        assert len(mine) == value(report, "added_points")[name] > 100
        assert np.allclose(mine.points, alone.points)
        assert np.abs(mine.colors.astype(int) - alone.colors).max() <= 1


def test_headers_of_the_clouds_name_their_frame_and_readers_pass_over_that(tmp_path):
    known = {"origin_latitude_deg": 47.5, "origin_longitude_deg": 9.0, "origin_altitude_m": 470.0, "length_unit": "m"}
    known |= {"crs": "EPSG:25832+7837", "origin_in_crs": [5e5, 5260875.25, 470.0], "crs_from_scene": np.eye(4)}
    write_json(tmp_path / "georeference.json", {name: quantity(item, "") for name, item in known.items()})
    objects = {"left": strip(0.03, 3, 1.54)}
    (tmp_path / "plain").mkdir()
    plain, _ = run(tmp_path / "plain", strip(0, 20), objects)
    whole, _ = run(tmp_path, strip(0, 20), objects, georeference=tmp_path / "georeference.json")
    assert np.array_equal(whole.points, plain.points) and whole.fields.keys() == plain.fields.keys()
    for name in ("completed.ply", "left/fused.ply", "left/checked.ply"):
        header = (tmp_path / name).read_bytes().split(b"end_header")[0].decode("ascii").splitlines()
        assert header[2:5] == [
            "comment x y z: metres east, north, up of 500000 5260875.25 470 in ETRS89 / UTM zone 32N + DHHN2016 height"
            " (EPSG:25832+7837)",
            "comment heights: DHHN2016 height",
            "comment into the CRS: not by adding the origin, for the grid's north is another;"
            " completed.copc.laz is in it",
        ]
        assert "comment x y z: scene units in a local frame" in (tmp_path / "plain" / name).read_bytes().decode(
            "latin1"
        )


def test_what_two_objects_share_is_added_once(tmp_path):
    scene, shared = strip(0, 20), strip(0.03, 3, 1.54)
    whole, report = run(tmp_path, scene, {"first": shared, "second": shared})
    assert value(report, "added_points")["first"] > 100 and value(report, "added_points")["second"] == 0


def test_where_objects_overlap_the_more_exactly_measured_one_stays():
    def measured(deviation, low, high):
        cloud = strip(low, high)
        return replace(cloud, fields={"deviation": np.full(len(cloud), deviation, np.float32)})

    coarse, fine, unknown = measured(0.1, 0, 3), measured(0.01, 2, 5), measured(np.nan, 4, 7)
    left = without_overlaps([coarse, unknown, fine])
    assert len(left[2]) == len(fine)
    assert left[0].points[:, 0].max() < 1.95 and left[1].points[:, 0].min() > 4.95


def test_replace_takes_the_scene_away_and_counts_it(tmp_path):
    scene = strip(0, 20)
    whole, report = run(tmp_path, scene, {"left": strip(0, 3), "right": strip(10, 13)}, mode="replace")
    left = whole.points[whole.fields["source"] == 0]
    assert value(report, "removed_points") == len(scene) - len(left) > 0
    for low, high in ((0, 2.5), (10.5, 12.5)):
        assert not ((left[:, 0] > low) & (left[:, 0] < high)).any()


def test_colours_that_are_changed_by_the_most_that_is_done_are_named(tmp_path):
    scene, obj = strip(0, 20), strip(0.03, 3, 0.04)
    run(tmp_path, scene, {"like": obj})
    assert not any("match_colors" in note for note in value(read_json(tmp_path / "like/fusion.json"), "notes"))
    run(tmp_path, replace(scene, colors=(100 + scene.colors // 8).astype(np.uint8)), {"vivid": obj})
    assert any("match_colors: false" in note for note in value(read_json(tmp_path / "vivid/fusion.json"), "notes"))


def test_an_unregistered_object_is_named_and_changes_nothing(tmp_path):
    scene = strip(0, 20)
    objects = {"weak": strip(0.03, 3, 1.54), "good": strip(10, 13, 1.5)}
    whole, report = run(tmp_path, scene, objects, "replace", ["weak"])
    assert value(report, "unregistered") == {"weak": "weak"} and list(value(report, "added_points")) == ["good"]
    assert set(whole.fields["source"]) == {0, 2}
    alone, _ = run(tmp_path, scene, {"weak": strip(0.03, 3, 1.54)}, "replace", ["weak"])
    assert np.array_equal(alone.points, scene.points)


def test_the_copc_file_holds_the_same_points_with_their_sources(tmp_path):
    whole, _ = run(tmp_path, strip(0, 20), {"left": strip(0.03, 3, 1.54)})
    las = laspy.read(tmp_path / "completed.copc.laz")
    order, other = (np.lexsort(np.round(points, 6).T) for points in (las.xyz, whole.points))
    assert np.allclose(las.xyz[order], whole.points[other], atol=1e-6)
    assert las.header.generating_software.startswith(f"scenefuse {VERSION}")
    assert np.array_equal(las["source"][order], whole.fields["source"][other]) and whole.fields["source"].max() == 1


def test_classes_and_intensities_of_the_scene_are_in_its_copc_file(tmp_path):
    scene = strip(0, 20)
    fields = {"classification": (scene.points[:, 0] < 7).astype(np.uint8) * 6}
    fields["intensity"] = (100 * scene.points[:, 0]).astype(np.uint16)
    whole, _ = run(tmp_path, replace(scene, fields=fields), {"left": strip(0.03, 3, 1.54)})
    las = laspy.read(tmp_path / "completed.copc.laz")
    added = np.asarray(las["source"]) == 1
    assert added.any() and not las.classification[added].any() and not las.intensity[added].any()
    assert np.array_equal(np.asarray(las.classification)[~added] == 6, las.x[~added] < 7)
    assert np.allclose(np.asarray(las.intensity)[~added], 100 * np.asarray(las.x)[~added], atol=1.01)
    assert {"classification", "intensity"} <= set(whole.fields)
    assert not {"classification", "intensity"} & set(las.point_format.extra_dimension_names)


def test_a_scene_of_which_nothing_is_left_is_an_error_without_outputs(tmp_path):
    with pytest.raises(StageError, match=r"of .*scene\.ply no point is left, and no object adds any"):
        run(tmp_path, strip(0, 0), {})
    assert not list(tmp_path.glob("completed*"))


def test_a_failed_object_is_named_with_its_reason_and_the_others_keep_their_numbers(tmp_path):
    scene = strip(0, 20)
    (tmp_path / "logs/make_masks").mkdir(parents=True)
    (tmp_path / "logs/make_masks/broken.log").write_text("error: 3.png is no readable picture\n")
    # What an earlier run left of the object is out of date.
    objects = {"broken": strip(0.03, 3, 1.54), "good": strip(10, 13, 1.5)}
    whole, report = run(tmp_path, scene, objects, "replace", failed=["broken", "absent"])
    assert value(report, "failed") == {
        "broken": "3.png is no readable picture [make_masks/broken.log]",
        "absent": "its jobs did not run",
    }
    assert set(whole.fields["source"]) == {0, 2} and list(value(report, "added_points")) == ["good"]
    assert value(report, "sources")["2"] == "good" and value(report, "unregistered") == {}
