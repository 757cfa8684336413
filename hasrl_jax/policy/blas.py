"""Environment variables for processes that act; they must be set before these load NumPy."""

import numpy as np

ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "VECLIB_MAXIMUM")}


def blas_variables() -> dict[str, str]:
    """What makes matrix products fast on this CPU.

    OpenBLAS takes a CPU that is newer than itself for one without AVX-512, at half the speed. NumPy asks the CPU: what
    it has chosen, and not what it was built with, says whether AVX-512 is there. Where it is not, the variable would
    kill the process at its first matrix product.
    """
    functions = np.lib.introspect.opt_func_info(func_name="tanh", signature="float32")
    chosen = {found["current"] for signatures in functions.values() for found in signatures.values()}
    return {"OPENBLAS_CORETYPE": "SkylakeX"} if chosen & {"X86_V4", "AVX512_SKX"} else {}
