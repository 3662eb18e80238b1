"""The bank of filters against that of filterpy, one robot at a time."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from numpy.typing import NDArray

from amberbox.detection.kalman import (
    BankState,
    LinearModels,
    correct,
    correct_one,
    mix,
    predict,
    switching,
)

Floats = NDArray[np.float64]
NO_FLOOR = 0.0


def peer(start: Floats, switch: Floats) -> IMMEstimator:
    """Return the same bank for one robot, by another library."""
    filters = []
    for _ in start:
        one = KalmanFilter(dim_x=4, dim_z=2)
        one.x, one.P = np.zeros(4), np.eye(4)
        filters.append(one)
    return IMMEstimator(filters, start, switch)


def peer_step(bank: IMMEstimator, models: LinearModels, z: Floats) -> None:
    for one, f, q, h, r in zip(bank.filters, models.f, models.q, models.h, models.r, strict=True):
        one.F, one.Q, one.H, one.R = f, q, h, r
    bank.predict()
    bank.update(z)


def models_at(dt: float, sensors: int = 2) -> LinearModels:
    """Return a robot in the plane that drives straight, turns, or stands; states x y vx vy."""
    straight = np.eye(4)
    straight[0, 2] = straight[1, 3] = dt
    turn = straight.copy()
    c, s = np.cos(0.5 * dt), np.sin(0.5 * dt)
    turn[2:, 2:] = [[c, -s], [s, c]]
    stand = np.diag([1.0, 1.0, 0.0, 0.0])
    f = np.stack([straight, turn, stand])
    q = np.stack([np.eye(4) * size * dt for size in (0.01, 0.05, 0.001)])
    h = np.broadcast_to(np.eye(4)[:sensors], (3, sensors, 4)).copy()
    noise = np.eye(sensors) * 0.04 + 0.01
    r = np.broadcast_to(noise, (3, sensors, sensors)).copy()
    return LinearModels(f, q, h, r, np.zeros((3, sensors), bool))


@pytest.mark.parametrize("robots", [1, 40])
def test_it_equals_another_library_to_1e_9(robots: int) -> None:
    random = np.random.default_rng(4)
    switch = switching(3, 0.95)
    start = np.array([0.5, 0.2, 0.3])
    state = BankState.at(np.zeros(4), np.eye(4), start, robots)
    bank = peer(start, switch)
    position = np.zeros(2)
    for step in range(400):
        dt = float(random.uniform(0.02, 0.3))
        position = position + (np.array([1.0, 0.3]) * dt if step < 200 else 0.0)
        z = position + random.normal(0, 0.2, 2)
        models = models_at(dt)
        mix(state, switch)
        predict(state, models)
        others = z + random.normal(0, 1, (robots, 2))
        others[robots // 2] = z
        if robots == 1:
            correct_one(state, models, z.tolist(), NO_FLOOR)
        else:
            correct(state, models, others, NO_FLOOR)
        peer_step(bank, models, z)
        own = robots // 2
        mean, covariance = state.combined()
        assert state.weights[own] == pytest.approx(bank.mu, abs=1e-9)
        assert mean[own] == pytest.approx(bank.x, abs=1e-9)
        assert covariance[own] == pytest.approx(bank.P, abs=1e-9)
        for number, one in enumerate(bank.filters):
            assert state.x[own, number] == pytest.approx(one.x, abs=1e-9)
            assert state.p[own, number] == pytest.approx(one.P, abs=1e-9)


def test_a_sensor_that_was_not_read_is_as_if_it_were_not_there() -> None:
    """The same filter with fewer rows of H is the oracle."""
    both, one = models_at(0.1), models_at(0.1, sensors=1)
    full = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3))
    short = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3))
    for value in (0.1, 0.5, -0.2):
        for state, models, z in ((full, both, [value, np.nan]), (short, one, [value])):
            predict(state, models)
            found = correct(state, models, np.array([z]), NO_FLOOR)
        assert found.log_likelihood.shape == (1, 3)
    assert full.x == pytest.approx(short.x, abs=1e-12)
    assert full.p == pytest.approx(short.p, abs=1e-12)
    assert full.weights == pytest.approx(short.weights, abs=1e-12)


def test_a_masked_sensor_does_not_move_the_state_and_its_model_wins_when_it_fails() -> None:
    plain = models_at(0.1)
    masked = np.array([[False, False], [False, False], [False, True]])
    same = np.stack([plain.f[0]] * 3)
    r = plain.r.copy()
    r[2] = [[0.05, 0], [0, 25.0]]
    models = LinearModels(same, np.stack([plain.q[0]] * 3), plain.h, r, masked)
    state = BankState.at(np.zeros(4), np.eye(4) * 0.1, np.full(3, 1 / 3))
    for step in range(20):
        predict(state, models)
        correct(state, models, np.array([[0.0, 8.0 if step % 2 else -4.0]]), 1e-9)
    assert state.weights[0].argmax() == 2
    assert abs(state.x[0, 2, 1]) < 1e-12  # the second coordinate was never measured
    assert abs(state.x[0, 0, 1]) > 0.5  # the others believed the sensor


def steps_until_noticed(stay: float, floor: float) -> int | None:
    """Return how long a bank needs to notice that a robot stands, after 3,000 steps of driving."""
    models, switch = models_at(0.1), switching(3, stay)
    state = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3))
    random = np.random.default_rng(1)
    position = 0.0
    for step in range(4000):
        position += 0.1 if step < 3000 else 0.0
        z = np.array([[position, 0.0]]) + random.normal(0, 0.2, (1, 2))
        if stay < 1:
            mix(state, switch)
        predict(state, models)
        correct(state, models, z, floor)
        if step == 2999:
            assert state.weights[0].argmax() == 0
        if step >= 3000 and state.weights[0, 2] > 0.5:
            return step - 3000
    return None


def test_long_nominal_operation_locks_no_model_out() -> None:
    """Without mixing and without a floor, the weight of the other model is gone for good."""
    with_mixing, with_floor = steps_until_noticed(0.999, 1e-9), steps_until_noticed(1.0, 1e-9)
    assert with_mixing is not None and with_floor is not None
    assert with_mixing < 50
    assert with_floor < 400  # its filter, which has drifted off, has to find the robot first
    assert steps_until_noticed(1.0, 0.0) is None


def test_a_robot_in_a_batch_is_as_if_it_were_alone() -> None:
    random = np.random.default_rng(2)
    values = random.normal(0, 1, (50, 100, 2))
    switch, models = switching(3, 0.9), models_at(0.1)
    many = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3), 100)
    alone = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3), 1)
    for z in values:
        for state, own in ((many, z), (alone, z[7:8])):
            mix(state, switch)
            predict(state, models)
            correct(state, models, own, 1e-9)
    assert many.x[7] == pytest.approx(alone.x[0], abs=1e-12)
    assert many.weights[7] == pytest.approx(alone.weights[0], abs=1e-12)


@pytest.mark.parametrize("sensors", [1, 2, 3, 4])
@pytest.mark.parametrize("hidden", [False, True])
def test_one_robot_in_numbers_is_as_one_in_arrays(sensors: int, hidden: bool) -> None:
    """Values that are missing, not finite, or far off, and sensors that a model hides."""
    random = np.random.default_rng(sensors)
    models = models_at(0.1, sensors)
    models.masked[2, -1] = hidden
    arrays = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3))
    numbers = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3))
    for _ in range(200):
        z = random.normal(0, 1, sensors)
        z[random.random(sensors) < 0.2] = random.choice([np.nan, np.inf, 1e6])
        for state in (arrays, numbers):
            mix(state, switching(3, 0.9))
            predict(state, models)
        many = correct(arrays, models, z[None], 1e-9)
        one = correct_one(numbers, models, z.tolist(), 1e-9)
        best = arrays.weights[0].argmax()
        assert one.weights == pytest.approx(arrays.weights[0], rel=1e-9, abs=1e-9)
        assert one.used == many.used[0, best].tolist()
        assert one.white == pytest.approx(many.white[0, best], rel=1e-9, abs=1e-9)
        assert one.innovations == pytest.approx(many.innovations[0, best], rel=1e-9, abs=1e-9)
        assert numbers.x == pytest.approx(arrays.x, rel=1e-9, abs=1e-9)
        assert numbers.p == pytest.approx(arrays.p, rel=1e-9, abs=1e-9)


def test_garbage_does_not_carry_the_state_away() -> None:
    models = models_at(0.1)
    state = BankState.at(np.zeros(4), np.eye(4), np.full(3, 1 / 3))
    for value in (0.0, 1e300, -1e300, 0.0):
        predict(state, models)
        correct(state, models, np.array([[value, np.inf]]), 1e-9)
    assert np.isfinite(state.x).all()
    assert np.abs(state.x).max() < 1000
    assert state.weights.sum() == pytest.approx(1)
