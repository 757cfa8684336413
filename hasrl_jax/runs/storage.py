"""How checkpoints use the storage library."""

import contextlib
import logging
from collections.abc import Iterator

import jax
import orbax.checkpoint as ocp


@contextlib.contextmanager
def open_storage() -> Iterator[ocp.Checkpointer]:
    """Writes and reads for this process alone, without messages on the terminal; failures arrive as exceptions."""
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"{me}")
    handler = ocp.CompositeCheckpointHandler(composite_options=ocp.CompositeOptions(multiprocessing_options=alone))
    logger, level = logging.getLogger("absl"), logging.getLogger("absl").level
    logger.setLevel(logging.CRITICAL)
    try:
        with ocp.Checkpointer(handler, multiprocessing_options=alone) as checkpointer:
            yield checkpointer
    finally:
        logger.setLevel(level)
