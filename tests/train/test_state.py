import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from avatarjax.train import make_step, new_state, weights
from avatarjax.train.state import SMALL, optimiser, packed, scheduled, together, unpacked


def quadratic(params, key, batch):
    loss = jnp.sum((params["w"] - batch) ** 2)
    return loss, {"largest": jnp.max(params["w"])}


TARGET = np.array([1.0, -2.0, 3.0], np.float32)
SGD = optax.sgd(0.1)


def fresh(key, transform=SGD, **options):
    return new_state({"w": jnp.zeros(3)}, transform, key, **options)


@pytest.fixture(scope="module")
def step():
    return make_step(quadratic, SGD, decay=0.5)


def copied(state):
    return jax.tree.map(np.array, (state.params, state.average, state.opt_state))


def test_a_step_goes_down_the_gradient(key, step):
    state, metrics = step(fresh(key), TARGET)
    np.testing.assert_allclose(state.params["w"], 0.2 * TARGET, rtol=1e-6)
    assert float(metrics["loss"]) == pytest.approx(14)
    assert float(metrics["gradient_norm"]) == pytest.approx(2 * np.sqrt(14))
    assert float(metrics["skipped"]) == 0 and float(metrics["largest"]) == 0
    assert int(state.step) == 1


def test_many_steps_reach_the_minimum(key, step):
    state = fresh(key)
    for _ in range(40):
        state, _ = step(state, TARGET)
    np.testing.assert_allclose(state.params["w"], TARGET, atol=1e-3)


def test_the_average_follows_the_weights(key, step):
    state = fresh(key, averaged=True)
    expected = np.zeros(3)
    for k in range(12):
        state, _ = step(state, TARGET)
        rate = min(0.5, (1 + k) / (10 + k))
        expected = rate * expected + (1 - rate) * np.asarray(state.params["w"])
    np.testing.assert_allclose(state.average["w"], expected, rtol=1e-5)
    assert weights(state) is state.average


def test_without_an_average_the_weights_are_the_parameters(key):
    state = fresh(key)
    assert state.average is None and weights(state) is state.params


def test_a_gradient_that_is_not_finite_changes_nothing_and_is_counted(key):
    transform = optax.adam(0.1)
    step = make_step(quadratic, transform, decay=0.5)
    state = fresh(key, transform, averaged=True)
    for _ in range(3):
        state, _ = step(state, TARGET)
    before = copied(state)
    state, metrics = step(state, np.full(3, np.nan, np.float32))
    jax.tree.map(np.testing.assert_array_equal, copied(state), before)
    assert float(metrics["skipped"]) == 1 and int(state.step) == 4
    state, metrics = step(state, TARGET)
    assert float(metrics["skipped"]) == 0
    assert not np.array_equal(state.params["w"], before[0]["w"])


def mixed():
    """A tree of small leaves, one without axes and one of other numbers, and a large one."""
    rng = np.random.default_rng(0)
    small = {"b": jnp.asarray(rng.normal(size=(3, 4)), jnp.float32), "a": jnp.float32(2.5)}
    return {"small": small, "large": jnp.asarray(rng.normal(size=SMALL + 1), jnp.float32), "half": jnp.ones(2, "half")}


def test_small_leaves_are_one_vector_and_come_back():
    tree = mixed()
    parts = packed(tree)
    assert [x.shape for x in parts] == [(SMALL + 1,), (15,)]
    back = unpacked(parts, tree)
    jax.tree.map(np.testing.assert_array_equal, back, tree)
    assert [x.dtype for x in jax.tree.leaves(back)] == [x.dtype for x in jax.tree.leaves(tree)]
    for one in ({"large": tree["large"]}, tree["small"]):
        jax.tree.map(np.testing.assert_array_equal, unpacked(packed(one), one), one)


def test_optimised_together_every_leaf_moves_as_alone():
    """Also with what needs the norm of all, and the parameters themselves."""
    plain = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(0.1))
    params = {k: v for k, v in mixed().items() if k != "half"}
    gradient = jax.tree.map(lambda x: x**2 + 1, params)
    ways = [(t, t.init(params)) for t in (plain, together(plain))]
    for _ in range(3):
        moves, states = zip(*(t.update(gradient, state, params) for t, state in ways), strict=True)
        ways = [(t, state) for (t, _), state in zip(ways, states, strict=True)]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), *moves)


def test_the_state_is_donated(key, step):
    state = fresh(key)
    step(state, TARGET)
    assert state.params["w"].is_deleted()


def test_the_callers_parameters_survive(key, step):
    params = {"w": jnp.zeros(3)}
    step(new_state(params, SGD, key), TARGET)
    np.testing.assert_array_equal(params["w"], 0)


def test_one_compilation_serves_all_steps(key):
    """Also from parameters of a weak type, which every step would make strong."""
    step = make_step(quadratic, SGD, decay=0.5)
    state = new_state({"w": jnp.full(3, 1.0)}, SGD, key, averaged=True)
    for _ in range(3):
        state, _ = step(state, TARGET)
    assert step._cache_size() == 1


def test_held_parameters_do_not_move(key):
    def hold(new, old, batch):
        return jax.tree.map(lambda n, o: jnp.where(batch > 0, n, o), new, old)

    step = make_step(quadratic, SGD, hold=hold)
    target = np.array([1.0, -2.0, 3.0], np.float32)
    state, _ = step(fresh(key), target)
    np.testing.assert_allclose(state.params["w"], [0.2, 0, 0.6], rtol=1e-6)


def test_in_the_average_held_parameters_are_the_parameters_themselves(key):
    """From the moment they are held: an average would go on moving towards them."""

    def hold(new, old, batch):
        return {"w": jnp.where(batch[0] > 0, new["w"], old["w"])}

    step = make_step(quadratic, optax.adam(0.1), decay=0.9, hold=hold)
    state = fresh(key, optax.adam(0.1), averaged=True)
    for _ in range(3):
        state, _ = step(state, TARGET)
    learned = np.array(state.params["w"])
    assert np.abs(state.average["w"] - learned).max() > 1e-3
    for _ in range(2):
        state, _ = step(state, -TARGET)
        np.testing.assert_array_equal(state.params["w"], learned)
        np.testing.assert_array_equal(state.average["w"], learned)


def test_every_step_has_its_own_randomness(key):
    step = make_step(lambda p, k, b: (jnp.sum(p["w"]) + jax.random.normal(k), {}), SGD)
    state, losses = fresh(key), []
    for _ in range(3):
        state, metrics = step(state, None)
        losses.append(float(metrics["loss"] - jnp.sum(state.params["w"] + 0.1)))
    assert len({round(x, 4) for x in losses}) == 3


def test_other_numbers_of_steps_are_the_same_program(key):
    def lowered(rate, steps):
        transform = optimiser(rate, steps)
        return make_step(quadratic, transform).lower(fresh(key, transform), TARGET).as_text()

    assert lowered(1e-3, 100) == lowered(1e-2, 5_000)


def test_the_rate_warms_up_then_decays_to_a_tenth():
    """Under a constant gradient Adam's steps are as long as the rate."""
    transform = optimiser(0.5, 100)
    state = transform.init(jnp.zeros(()))
    update = jax.jit(transform.update)
    rates = []
    for _ in range(101):
        step, state = update(jnp.asarray(0.3), state)
        rates.append(-float(step))
    assert rates[0] == pytest.approx(0.025, rel=1e-2)
    assert max(rates) == pytest.approx(0.5, rel=1e-2) and int(np.argmax(rates)) == 3
    assert rates[-1] == pytest.approx(0.05, rel=1e-2)
    published = optax.warmup_cosine_decay_schedule(0.025, 0.5, 3, 100, 0.05)
    moves = scheduled(0.5, 100)
    state = moves.init(None)
    for k in range(120):
        step, state = moves.update(jnp.ones(()), state)
        assert float(step) == pytest.approx(-float(published(k)), rel=1e-4)
    assert (np.diff(rates[3:]) < 1e-5).all()
