import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.errors import RunDirectoryError, RunLockedError, StorageError
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.storage.run_directory import (
    RunDirectory,
    key_of,
    read_array,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
)


def test_a_finished_stage_is_done_under_its_key_only(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out") as run:
        assert not run.stage("mapping", key="k1").is_done
        with run.stage("mapping", key="k1").write() as folder:
            (folder / "result.txt").write_text("42")
        stage = run.stage("mapping", key="k1")
        assert stage.is_done
        assert (stage.path / "result.txt").read_text() == "42"
        assert not run.stage("mapping", key="k2").is_done


def test_an_interrupted_stage_leaves_nothing_that_looks_finished(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out") as run:
        stage = run.stage("mapping", key="k1")
        with pytest.raises(KeyboardInterrupt), stage.write() as folder:
            (folder / "half.txt").write_text("half")
            raise KeyboardInterrupt
        assert not stage.is_done
        assert not stage.path.exists()
    with RunDirectory(tmp_path / "out") as run:
        assert sorted(path.name for path in run.work.iterdir()) == ["lock"]


def test_a_new_key_replaces_the_old_content(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out") as run:
        for key in ("k1", "k2"):
            with run.stage("depth", key=key).write() as folder:
                (folder / f"{key}.txt").write_text(key)
        assert {path.name for path in (run.work / "depth").iterdir()} == {"k2.txt", "stage.json"}


def test_a_store_opened_in_place_keeps_its_content_until_the_key_changes(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out") as run:
        (run.stage("features", key="k1").open_in_place() / "database.db").write_text("rows")
        assert (run.stage("features", key="k1").open_in_place() / "database.db").exists()
        assert not (run.stage("features", key="k2").open_in_place() / "database.db").exists()


def test_starting_over_forgets_everything_but_what_somebody_else_put_there(tmp_path: Path) -> None:
    root = tmp_path / "out"
    with RunDirectory(root) as run:
        with run.stage("mapping", key="k").write():
            pass
        (root / "points.ply").write_text("old")
        run.sparse_model(0).mkdir(parents=True)
        (run.sparse_model(0) / "images.bin").write_text("old")
        (run.sparse_model(0) / "notes.txt").write_text("theirs")
    with RunDirectory(root) as run:
        run.start_over({"images.bin"})
        assert not run.stage("mapping", key="k").is_done
    left = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    assert left == ["sparse/0/notes.txt", "work/lock"]


@pytest.mark.slow
def test_a_second_process_is_refused_while_the_first_lives(tmp_path: Path) -> None:
    root = tmp_path / "out"
    code = f"""
from pathlib import Path
from smust3r_colmap.storage.run_directory import RunDirectory
RunDirectory(Path({str(root)!r}))
"""
    with RunDirectory(root):
        second = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert second.returncode == 1
        assert "RunLockedError" in second.stderr
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_a_lock_that_a_killed_run_leaves_for_a_moment_is_waited_for(tmp_path: Path) -> None:
    """As when kill -9 meets a run between fork and exec of a child, which holds the lock until its exec."""
    root = tmp_path / "out"
    code = f"""
import time
from pathlib import Path
from smust3r_colmap.storage.run_directory import RunDirectory
with RunDirectory(Path({str(root)!r})):
    print("held", flush=True)
    time.sleep(0.5)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "held\n"
        with RunDirectory(root):
            pass
    assert first.returncode == 0


def test_the_same_process_is_refused_too(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out"), pytest.raises(RunLockedError, match="another process is writing"):
        RunDirectory(tmp_path / "out")


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(RunDirectoryError, match="not made by this program"):
        RunDirectory(tmp_path)
    assert (tmp_path / "thesis.txt").exists()


def test_a_work_folder_of_somebody_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "work/thesis.txt").write_text("years of work")
    with pytest.raises(RunDirectoryError, match="not made by this program"):
        RunDirectory(tmp_path)
    assert (tmp_path / "work/thesis.txt").exists()


def test_a_folder_left_before_it_was_locked_is_taken(tmp_path: Path) -> None:
    (tmp_path / "out/work").mkdir(parents=True)
    with RunDirectory(tmp_path / "out") as run:
        assert run.work.is_dir()


def test_a_file_as_output_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(RunDirectoryError, match="is a file"):
        RunDirectory(tmp_path / "out")


def test_a_dangling_link_as_output_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "unplugged")
    with pytest.raises(RunDirectoryError, match=r"out: is a link to .*unplugged, which is not there"):
        RunDirectory(tmp_path / "out")


def test_a_name_that_the_system_does_not_take_is_told_in_its_words(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"File name too long"):
        RunDirectory(tmp_path / ("n" * 300))


def test_what_the_disk_has_no_room_for_is_not_begun(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out") as run:
        run.check_space("the features", 1000)
        with pytest.raises(
            StorageError, match=r"out: the features need about 1073741824 MiB, and \d+ MiB are free; .*goes"
        ):
            run.check_space("the features", 2**50)


def test_a_full_disk_is_named_and_finished_stages_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RunDirectory(tmp_path / "out") as run:
        with run.stage("mapping", key="k").write():
            pass

        def full(*_: object, **__: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(Path, "write_text", full)
        message = r"depth.*No space left on device.*finished stages are kept"
        with pytest.raises(StorageError, match=message), run.stage("depth", key="k").write():
            pass
        monkeypatch.undo()
        assert run.stage("mapping", key="k").is_done
        assert not run.stage("depth", key="k").is_done


def test_keys_differ_when_any_input_differs() -> None:
    camera = Intrinsics(model="PINHOLE", width=4, height=3, params=(5, 5, 2, 1.5))
    keys = [
        key_of("a", 1),
        key_of("a", 2),
        key_of("b", 1),
        key_of("a", camera),
        key_of("a", np.zeros(3)),
        key_of("a", np.zeros(3, np.float32)),
        key_of("a", np.array([0.0, 0.0, 1e-12])),
    ]
    assert len(set(keys)) == len(keys)
    assert key_of("a", np.zeros(3), camera) == key_of("a", np.zeros(3), camera)


def test_arrays_come_back_as_they_were(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6, dtype=np.float64).reshape(2, 3).T, "b": np.array([1, 2], np.uint8)}
    write_arrays(tmp_path / "x.safetensors", arrays)
    back = read_arrays(tmp_path / "x.safetensors")
    for name, value in arrays.items():
        np.testing.assert_array_equal(back[name], value)
        np.testing.assert_array_equal(read_array(tmp_path / "x.safetensors", name), value)


def test_broken_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "x.safetensors").write_bytes(b"garbage")
    with pytest.raises(StorageError, match=r"x\.safetensors"):
        read_arrays(tmp_path / "x.safetensors")
    (tmp_path / "half.json").write_text('{"a": ')
    with pytest.raises(StorageError, match=r"half\.json: is damaged .*--overwrite"):
        read_json(tmp_path / "half.json")
    with pytest.raises(StorageError, match=r"absent\.json"):
        read_json(tmp_path / "absent.json")


def test_json_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    write_json(tmp_path / "f.json", {"a": 1})
    with pytest.raises(ValueError, match="Out of range float"):
        write_json(tmp_path / "f.json", {"a": float("nan")})
    assert json.loads((tmp_path / "f.json").read_text()) == {"a": 1}


def test_results_of_an_earlier_run_go_and_foreign_files_stay(tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "out") as run:
        for number in (0, 1):
            run.sparse_model(number).mkdir(parents=True)
            (run.sparse_model(number) / "images.bin").write_bytes(b"old")
        (run.sparse_model(0) / "points3D.ply").write_bytes(b"made by a trainer")
        (run.root / "points.ply").write_bytes(b"old")
        run.clear_results({"images.bin"})
        assert [path.name for path in run.root.rglob("*") if path.is_file() and "work" not in path.parts] == [
            "points3D.ply"
        ]
        assert not run.sparse_model(1).exists()
