"""The loop: what is interrupted goes on as if it had not been, what is finished or foreign is told apart."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from avatarjax.train import fit, loop, make_step, new_state, read_metrics

STEPS = 8
TRANSFORM = optax.adam(0.1)


def noisy(params, key, batch):
    return jnp.sum((params["w"] - batch - 0.1 * jax.random.normal(key, (3,))) ** 2), {}


@pytest.fixture(scope="module")
def step():
    return make_step(noisy, TRANSFORM, decay=0.9)


def fresh():
    return new_state({"w": jnp.zeros(3)}, TRANSFORM, jax.random.key(5), averaged=True)


def batch_at(k):
    return np.random.default_rng(k).normal(size=3).astype(np.float32)


def leaves(state):
    return jax.tree.leaves((state.params, state.average, state.opt_state, state.step, jax.random.key_data(state.key)))


def test_an_interrupted_run_goes_on_bit_for_bit(step, tmp_path, monkeypatch):
    whole = fit(step, fresh(), batch_at, STEPS, tmp_path, "whole")
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", -1.0)

    def interrupted(k):
        if k == 5:
            raise KeyboardInterrupt
        return batch_at(k)

    with pytest.raises(KeyboardInterrupt):
        fit(step, fresh(), interrupted, STEPS, tmp_path, "cut")
    again = []
    resumed = fit(step, fresh(), lambda k: again.append(k) or batch_at(k), STEPS, tmp_path, "cut")
    assert again == [5, 6, 7]
    for a, b in zip(leaves(resumed), leaves(whole), strict=True):
        np.testing.assert_array_equal(a, b)
    records = [[(r["step"], r["loss"]) for r in read_metrics(tmp_path / f"{n}.jsonl")] for n in ("cut", "whole")]
    assert records[0] == records[1] and [k for k, _ in records[0]] == list(range(1, STEPS + 1))


def test_metrics_written_after_the_last_checkpoint_are_written_anew(step, tmp_path):
    fit(step, fresh(), batch_at, 3, tmp_path, "run")
    with (tmp_path / "run.jsonl").open("a") as f:
        f.write('{"step": 4, "loss": -1.0}\n{"step": 5, "lo')
    fit(step, fresh(), batch_at, STEPS, tmp_path, "run")
    records = read_metrics(tmp_path / "run.jsonl")
    assert [r["step"] for r in records] == list(range(1, STEPS + 1)) and min(r["loss"] for r in records) > 0


def test_a_finished_run_is_read_back(step, tmp_path):
    first = leaves(fit(step, fresh(), batch_at, STEPS, tmp_path, "run", fingerprint="a"))

    def never(*_):
        raise AssertionError("a finished run needs no step")

    for a, b in zip(leaves(fit(never, fresh(), never, STEPS, tmp_path, "run", fingerprint="a")), first, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_checkpoint_of_something_else_is_ignored(step, tmp_path):
    fit(step, fresh(), batch_at, STEPS, tmp_path, "run", fingerprint="a")
    seen = []
    fit(step, fresh(), lambda k: seen.append(k) or batch_at(k), STEPS, tmp_path, "run", fingerprint="b")
    assert seen == list(range(STEPS))
    assert [r["step"] for r in read_metrics(tmp_path / "run.jsonl")] == list(range(1, STEPS + 1))


def test_a_checkpoint_of_another_optimiser_is_ignored(step, tmp_path):
    """Its state is of other arrays, which could not be gone on with."""
    plain = optax.sgd(0.1)
    begin = new_state({"w": jnp.zeros(3)}, plain, jax.random.key(5))
    fit(make_step(noisy, plain), begin, batch_at, 2, tmp_path, "run", fingerprint="a")
    seen = []
    fit(step, fresh(), lambda k: seen.append(k) or batch_at(k), STEPS, tmp_path, "run", fingerprint="a")
    assert seen == list(range(STEPS))


def test_a_truncated_checkpoint_is_named(step, tmp_path):
    fit(step, fresh(), batch_at, 2, tmp_path, "run")
    path = tmp_path / "run.safetensors"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"run\.safetensors is not a whole"):
        fit(step, fresh(), batch_at, STEPS, tmp_path, "run")


def test_a_cut_last_line_of_metrics_is_dropped(tmp_path):
    (tmp_path / "m.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.5}\n{"step": 3, "lo')
    assert read_metrics(tmp_path / "m.jsonl") == [{"step": 1, "loss": 2.0}, {"step": 2, "loss": 1.5}]


def test_no_metrics_file_has_no_records(tmp_path):
    assert read_metrics(tmp_path / "nothing.jsonl") == []


def test_intervals_report_the_mean_loss(step, tmp_path):
    fit(step, fresh(), batch_at, STEPS, tmp_path, "every")
    fit(step, fresh(), batch_at, STEPS, tmp_path, "halves", log_points=2)
    every = [r["loss"] for r in read_metrics(tmp_path / "every.jsonl")]
    halves = read_metrics(tmp_path / "halves.jsonl")
    assert [r["step"] for r in halves] == [4, 8]
    np.testing.assert_allclose([r["loss"] for r in halves], [np.mean(every[:4]), np.mean(every[4:])], rtol=1e-6)


def test_a_run_without_one_finite_gradient_stops(step, tmp_path):
    with pytest.raises(FloatingPointError, match="no step up to 2 had a finite gradient"):
        fit(step, fresh(), lambda k: np.full(3, np.inf, np.float32), STEPS, tmp_path, "run", log_points=4)
