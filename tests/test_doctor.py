"""The doctor's word on GPUs."""

import pytest

from hasrl_jax.cli import doctor


@pytest.mark.parametrize(("there", "status"), [(True, "warn"), (False, "ok")])
def test_a_gpu_that_jax_does_not_use(there: bool, status: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "has_nvidia_gpu", lambda: there)
    (check,) = doctor.check_devices()
    assert check.status == status
    assert ("[cuda]" in check.text) == there
