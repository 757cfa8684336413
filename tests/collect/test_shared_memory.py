"""The block of memory that the pool and its workers share."""

import errno
import os

import numpy as np
import pytest

from hasrl_jax.collect import shared_memory
from hasrl_jax.collect.plan import make_plan


@pytest.fixture
def block(make_config):
    config = make_config(num_workers=2)
    block = shared_memory.open_block(config, make_plan(config), 2, 1)
    yield block
    block.close()


def all_arrays(block):
    yield block.heartbeat
    for buffer in range(shared_memory.NUM_BUFFERS):
        yield from block.parameters[buffer].values()
        for slot in block.slots[buffer]:
            yield from slot.values()


def test_no_two_arrays_overlap(block):
    for number, array in enumerate(all_arrays(block)):
        array[...] = number % 2 if array.dtype == bool else number
    for number, array in enumerate(all_arrays(block)):
        assert np.all(array == (number % 2 if array.dtype == bool else number))


def test_arrays_are_aligned_and_inside(block):
    start = block.heartbeat.ctypes.data
    for array in all_arrays(block):
        offset = array.ctypes.data - start
        assert offset % shared_memory.ALIGNMENT == 0
        assert 0 <= offset <= block.size - array.nbytes


def test_a_second_view_sees_what_the_first_wrote(block, make_config):
    config = make_config(num_workers=2)
    other = shared_memory.open_block(config, make_plan(config), 2, 1, os.dup(block.descriptor))
    block.slots[1][1]["reward"][:] = 7.0
    assert np.all(other.slots[1][1]["reward"] == 7.0)
    assert np.all(other.slots[0][1]["reward"] == 0.0)
    other.close()


def test_closing_with_an_array_still_held_raises_nothing(make_config):
    config = make_config()
    block = shared_memory.open_block(config, make_plan(config), 2, 1)
    held = block.slots[0][0]["reward"]  # as the traceback of an exception under way would
    block.close()
    assert held.size == 96


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="memory is reserved at once on Linux only")
def test_too_little_memory_is_one_readable_error(make_config, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    config = make_config()
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match=r"cannot reserve .* MiB .* lower collect.env_steps_per_iteration"):
        shared_memory.open_block(config, make_plan(config), 2, 1)
    assert len(os.listdir("/proc/self/fd")) == before
