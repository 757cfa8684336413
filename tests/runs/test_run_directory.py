"""A run directory belongs to one run and one process, and says so when it cannot be used."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hasrl_jax.config.convert import from_dict
from hasrl_jax.config.files import dump_yaml
from hasrl_jax.config.schema import Config
from hasrl_jax.errors import RunError
from hasrl_jax.runs.directory import RunDirectory, load_run_config, open_run

HOLD = """
import sys, time
from hasrl_jax.config.convert import from_dict
from hasrl_jax.runs.directory import open_run
with open_run(from_dict({"run_dir": sys.argv[1]}), resume=False):
    print("held", flush=True)
    time.sleep(60)
"""


def disk_full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def config_for(path: Path, **changes: object) -> Config:
    return from_dict({"run_dir": str(path), "collect": {"num_workers": 3}, **changes})


def test_new_run_and_resume(tmp_path: Path) -> None:
    config = config_for(tmp_path / "a" / "run", task="cartpole")
    with open_run(config, resume=False) as run:
        assert run == RunDirectory(tmp_path / "a" / "run")
        assert run.checkpoints == run.path / "checkpoints" and run.checkpoints.is_dir()
        assert load_run_config(run.path) == config
    with open_run(config, resume=True) as run:
        assert run.path == tmp_path / "a" / "run"


def test_default_names_are_never_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open_run(from_dict({}), resume=False) as first, open_run(from_dict({}), resume=False) as second:
        assert first.path != second.path
        assert all(run.path.match("runs/cassie-20*-*") for run in (first, second))


@pytest.mark.parametrize("name", ["config.yaml", "metrics.jsonl", "checkpoints", "tensorboard", "run.lock"])
def test_links_that_lead_out_of_a_run_are_not_followed(tmp_path: Path, name: str) -> None:
    config, outside = config_for(tmp_path / "run"), tmp_path / "outside"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(outside)
    complaint = rf"^{tmp_path}/run/{name}: a link that leads out of the run, to {outside}; put what it names here$"
    with pytest.raises(RunError, match=complaint), open_run(config, resume=False):
        pass
    assert not outside.exists()
    (tmp_path / "run" / name).unlink()
    with open_run(config, resume=False):
        pass
    (tmp_path / "run" / name).rename(outside)
    (tmp_path / "run" / name).symlink_to(outside)
    with pytest.raises(RunError, match=complaint), open_run(config, resume=True):
        pass
    with pytest.raises(RunError, match=complaint):
        load_run_config(tmp_path / "run")


def test_a_link_to_a_whole_run_is_that_run(tmp_path: Path) -> None:
    with open_run(config_for(tmp_path / "run"), resume=False):
        pass
    (tmp_path / "newest").symlink_to(tmp_path / "run")
    assert load_run_config(tmp_path / "newest").collect.num_workers == 3
    with open_run(config_for(tmp_path / "newest"), resume=True):
        pass


@pytest.mark.parametrize(("private", "others"), [(True, 0), (False, 0o55)])
def test_a_private_run_is_open_to_its_owner_alone(
    tmp_path: Path, private: bool, others: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = os.umask(0o022)
    try:
        for run_dir in ("", "named"):
            with open_run(from_dict({"run_dir": run_dir, "private": private}), resume=False) as run:
                assert run.path.stat().st_mode & 0o777 == 0o700 | others
    finally:
        os.umask(before)


def test_refuses_a_second_run_in_the_same_directory(tmp_path: Path) -> None:
    config = config_for(tmp_path)
    with open_run(config, resume=False):
        pass
    before = (tmp_path / "config.yaml").read_bytes()
    with pytest.raises(RunError, match=f"{tmp_path}: already holds a run; continue it with --resume"):
        open_run(config_for(tmp_path, seed=5), resume=False).__enter__()
    assert (tmp_path / "config.yaml").read_bytes() == before
    (tmp_path / "config.yaml").unlink()
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 1}\n')
    with pytest.raises(RunError, match="holds parts of a run"):
        open_run(config, resume=False).__enter__()


@pytest.mark.parametrize("name", ["thesis.txt", "walk/config.yaml"])
def test_a_folder_of_other_files_is_refused_and_left_as_it_is(tmp_path: Path, name: str) -> None:
    theirs = tmp_path / "theirs"
    (theirs / name).parent.mkdir(parents=True)
    (theirs / name).write_text("mine")
    theirs.chmod(0o755)
    complaint = f"^{theirs}: holds {name.partition('/')[0]} and no run; choose a new folder, {theirs}/NAME$"
    with pytest.raises(RunError, match=complaint), open_run(config_for(theirs, private=True), resume=False):
        pass
    assert [file for file in theirs.rglob("*") if file.is_file()] == [theirs / name]
    assert theirs.stat().st_mode & 0o777 == 0o755


def test_a_folder_that_is_as_good_as_empty_is_taken(tmp_path: Path) -> None:
    (tmp_path / "log.txt").touch()
    (tmp_path / "films").mkdir()
    (tmp_path / ".gitignore").write_text("*")
    (tmp_path / "link").symlink_to("nowhere")
    with open_run(config_for(tmp_path), resume=False) as run:
        assert run.path == tmp_path


def test_a_failed_start_does_not_block_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_for(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", disk_full)
        with pytest.raises(RunError, match=r"config\.yaml: cannot be written: No space left on device"):
            open_run(config, resume=False).__enter__()
    with open_run(config, resume=False):
        pass


def test_lock_is_exclusive_and_ends_with_its_holder(tmp_path: Path) -> None:
    root = Path(__file__).parents[2]
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True, cwd=root)
    assert holder.stdout is not None and holder.stdout.readline() == "held\n"
    try:
        for resume in (True, False):
            with pytest.raises(RunError, match=f"{tmp_path}: in use by another run, process {holder.pid}$"):
                open_run(config_for(tmp_path), resume).__enter__()
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
        holder.stdout.close()
    with open_run(config_for(tmp_path), resume=True):
        assert (tmp_path / "run.lock").read_text() == str(os.getpid())


def test_children_do_not_inherit_the_lock(tmp_path: Path) -> None:
    config = config_for(tmp_path)
    with open_run(config, resume=False):
        child = subprocess.Popen(["sleep", "60"])
    try:
        with open_run(config, resume=True):
            pass
    finally:
        child.kill()
        child.wait()


def test_missing_and_foreign_directories(tmp_path: Path) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "notes.txt").write_text("mine")
    for name, message in (("missing", "there is no such run directory"), ("foreign", "not a run directory")):
        for use in (load_run_config, lambda path: open_run(config_for(path), resume=True).__enter__()):
            with pytest.raises(RunError, match=f"{tmp_path / name}: {message}"):
                use(tmp_path / name)
    assert not (tmp_path / "missing").exists()
    assert [path.name for path in (tmp_path / "foreign").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: text[: len(text) // 2],
        lambda text: text[:-2],
        lambda text: text.replace("task:", "tusk:"),
        lambda text: text.replace("clip: 0.2", "clip: 7.0"),
        lambda text: text.replace("seed: 0", "seed: [0"),
        lambda text: "- 1\n",
        lambda text: "\udcff",
    ],
)
def test_damaged_configuration(tmp_path: Path, damage) -> None:
    text = damage(dump_yaml(from_dict({})))
    (tmp_path / "config.yaml").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(RunError, match=rf"^{tmp_path}/config\.yaml: [^\n]+$"):
        load_run_config(tmp_path)


def test_a_configuration_from_before_a_setting_existed_is_read(tmp_path: Path) -> None:
    config = config_for(tmp_path)
    whole = dump_yaml(config)
    begin, end = whole.index("decoupled:\n"), whole.index("evaluate:\n")
    (tmp_path / "config.yaml").write_text(whole[:begin] + whole[end:])
    assert load_run_config(tmp_path) == config


def test_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name, reason in (("file", "that is a file; expected a folder"), ("file/run", "Not a directory")):
        with pytest.raises(RunError, match=f"{tmp_path / name}: the run directory cannot be created: {reason}"):
            open_run(config_for(tmp_path / name), resume=False).__enter__()


def test_a_path_that_the_language_of_the_system_cannot_spell_is_one_line(tmp_path: Path) -> None:
    name = "ü".encode().decode("ascii", "surrogateescape")  # as Python reads it where only ASCII is known
    with pytest.raises(RunError, match=r"udcc3.*: checkpoints need a path in UTF-8; set PYTHONUTF8=1") as caught:
        open_run(config_for(tmp_path / name), resume=False).__enter__()
    str(caught.value).encode()
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="permissions do not bind the superuser")
def test_no_write_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(RunError, match=f"{tmp_path}: cannot be written: Permission denied"):
        open_run(config_for(tmp_path), resume=False).__enter__()


def test_write_permission_is_proved_by_writing(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").write_text("")
    with pytest.raises(RunError, match=f"{tmp_path}/checkpoints: cannot be written: File exists"):
        open_run(config_for(tmp_path), resume=False).__enter__()
    assert not (tmp_path / "config.yaml").exists()
