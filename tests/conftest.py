"""The default tests need neither a network nor a GPU, and leave the user's caches alone."""

import functools
import os

import pytest
from filelock import FileLock

# Before anything imports huggingface_hub, which reads it once.
for name in ("HF_HUB_OFFLINE", "HF_DATASETS_OFFLINE", "TRANSFORMERS_OFFLINE"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("WANDB_MODE", "disabled")
# Before anything imports torch. The tests run in several processes, and so do the commands that they start.
os.environ.setdefault("OMP_NUM_THREADS", "1")


# `small_policies` is imported where it is used: it imports LeRobot, which takes 10 s. Each dataset is written
# once, so a test that changes files changes a copy.


@pytest.fixture
def spy(monkeypatch):
    """`spy(owner, name, note)` lets `note` have the arguments of a function, too, before its calls."""

    def spy(owner, name, note):
        function = getattr(owner, name)

        def noted(*arguments, **options):
            note(*arguments, **options)
            return function(*arguments, **options)

        monkeypatch.setattr(owner, name, noted)

    return spy


@pytest.fixture
def fake_language(monkeypatch):
    """Replaces all sentence encoders by a fake one."""
    from small_policies import use_fake_encoder

    use_fake_encoder(monkeypatch)


@pytest.fixture
def short_fit(monkeypatch):
    """Fits feature matching in two steps to colors, where what it learns does not matter."""
    from small_policies import use_short_fit

    use_short_fit(monkeypatch)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """A small dataset unlike the benchmark's."""
    from small_policies import hold_in_memory, write_dataset

    return hold_in_memory(write_dataset(tmp_path_factory.mktemp("data") / "foreign"))


def written_once(tmp_path_factory, name, write):
    """Returns a folder that one of the test processes writes, and the others wait for."""
    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    with FileLock(folder / f"{name}.lock"):
        if not (folder / name).exists():
            write(folder / f"{name}.part")
            (folder / f"{name}.part").rename(folder / name)
    return folder / name


@pytest.fixture(scope="session")
def table(tmp_path_factory):
    """A dataset of 48 episodes of `random_moves`."""
    from small_policies import LeRobotDataset, hold_in_memory, random_moves, write_table

    root = written_once(tmp_path_factory, "table", lambda root: write_table(root, random_moves(48)))
    return hold_in_memory(LeRobotDataset("test/table", root=root))


@pytest.fixture(scope="session")
def benchmark(tmp_path_factory):
    """The folder of a small dataset of the benchmark."""
    from small_policies import collect_benchmark

    return written_once(tmp_path_factory, "small", collect_benchmark)


@pytest.fixture
def make(dataset):
    """Makes a small policy and its processors."""
    from small_policies import small_policy

    return functools.partial(small_policy, dataset)
