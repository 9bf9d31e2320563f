"""The border with GTSAM: keys, tangents, and our physics as its factors.

GTSAM's pose tangent is (rotation, translation in B) and its bias stands in B axes, since it is fed with samples in B.
Everything is converted here and nowhere else; docs/conventions.md (46) to (48).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeAlias

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X
from numpy.typing import NDArray

from ...datasets.compiling.decorators import compiled, inner
from ...datasets.epochs import ATTITUDE, DEPTH, DVL, GPS, HEADING, SENSOR
from ...datasets.errors import message_of
from ...datasets.state import ACCEL_BIAS, DIM, GYRO_BIAS, POSITION, THETA, VELOCITY, Array, NavState
from ..interface import Diverged, unknown_kind
from ..physics.blocks import TOP, identity, rows_times
from ..physics.dvl_preintegration import given_rotation
from ..physics.imu import BLOCK, HELD_ACCEL, HELD_RATE, arm_velocity, increments, predict, process_noise, unbiased
from ..physics.invariant import invariant_after_error, local_invariant, spread_velocity, to_invariant
from ..physics.measurements import measure, preintegrated_dvl_residual, tight_dvl_residual
from ..physics.so3 import (
    exp_into,
    inverse_transform_into,
    log,
    log_into,
    product,
    product_into,
    right_jacobian,
    right_jacobian_into,
    transform_into,
)
from ..physics.state import ACCEL_BIAS_0, GYRO_BIAS_0, POSITION_0, STATE, THETA_0, VELOCITY_0
from ..stages import stage, staged

Linearised: TypeAlias = tuple[Array, ...]
"""A residual (k,) and its Jacobians (k, 3 or 6) by the variables of a factor, in GTSAM's tangents."""
OF_PLACE: Any = np.int64(3)
"""Where the translation begins in GTSAM's pose tangent: (rotation, translation)."""
OF_GYRO: Any = np.int64(3)
"""Where the gyro begins in GTSAM's bias: (accelerometer, gyro)."""
NO_BLOCK = np.zeros(1, BLOCK)
ZERO, NO_BIAS = np.zeros(3), np.zeros(6)
"""For factors that do not depend on velocity or bias."""
LEAST_WALK = 1e-4
"""1/s: GTSAM needs a bias that walks; this fraction of the white noise has no visible effect."""
INTEGRATION_DENSITY = 1e-5
"""m/√s: GTSAM needs some; ten micrometres in a second keep a block of one sample regular."""


@compiled
def equivalent_samples(
    imu: NDArray[Any], before: NDArray[Any], rig: NDArray[Any], block: NDArray[Any]
) -> tuple[Array, Array, Array]:
    """Samples that GTSAM's tangent preintegration turns into exactly the motion of `block` (`imu.integrate`).

    GTSAM sums theta += J_r⁻¹(theta) w dt, Δv += ΔR f dt and Δp += Δv dt + ½ ΔR f dt². So w is the step of Log ΔR
    through J_r, and f dt the push with coning, sculling and the lever arm's ω₀ × l − ΔR₁ (ω₁ × l), which telescopes.
    What the sum then lacks of Δp goes as one more push at the start and its opposite at the end.

    Args:
        imu, before, rig: what the block was integrated from.
        block: BLOCK record of length 1.

    Returns:
        accel (n, 3) m/s², gyro (n, 3) rad/s in B axes, the block's biases put back in; dt (n,) s.
    """
    g, b, n = rig[0], block[0], len(imu)
    rates, forces, dts = unbiased(imu, before, b.b_a[:], b.b_g[:], g.R_BI[:])
    accel, gyro, matrices, vectors = np.empty((n, 3)), np.empty((n, 3)), np.empty((4, 3, 3)), np.zeros((11, 3))
    phi, push, drift, theta, v, p = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    rate_arm, lever, step, reached, lacking = vectors[6], vectors[7], vectors[8], vectors[9], vectors[10]
    R, R_last, turn, J = matrices[0], matrices[1], matrices[2], matrices[3]
    identity(R)
    arm_velocity(before[0], rates[0], g, lever, rate_arm)
    for k in range(n):
        dt = dts[k + 1]
        increments(rates, forces, dts, k, phi, push, drift)
        exp_into(phi, turn)
        for i in range(3):
            push[i] += rate_arm[i]
        arm_velocity(imu[k], rates[k + 1], g, lever, rate_arm)
        transform_into(turn, rate_arm, lever)
        for i in range(3):
            push[i] -= lever[i]
            for j in range(3):
                R_last[i, j] = R[i, j]
        product_into(R_last, turn, R)
        transform_into(R_last, push, step)
        for i in range(3):
            p[i] += dt * v[i] + 0.5 * dt * step[i]
            v[i] += step[i]
        log_into(R, reached)
        right_jacobian_into(theta, J)
        for i in range(3):
            lever[i] = reached[i] - theta[i]
        transform_into(J, lever, step)
        for i in range(3):
            gyro[k, i], accel[k, i], theta[i] = step[i] / dt, push[i] / dt, reached[i]
    if n > 1:
        for i in range(3):
            lacking[i] = (b.dp[i] - p[i]) / (b.T - 0.5 * (dts[1] + dts[n]))
        inverse_transform_into(R_last, lacking, step)
        for i in range(3):
            accel[0, i] += lacking[i] / dts[1]
            accel[n - 1, i] -= step[i] / dts[n]
    for k in range(n):
        for i in range(3):
            for j in range(3):
                accel[k, i] += g.R_BI[i, j] * b.b_a[j]
                gyro[k, i] += g.R_BI[i, j] * b.b_g[j]
    return accel, gyro, dts[1:]


@stage("propagation")
def preintegrate_imu(
    imu: NDArray[Any], before: NDArray[Any], block: NDArray[Any], rig: NDArray[Any], p_WB_W: Array = ZERO
) -> gtsam.PreintegratedCombinedMeasurements:
    """Return GTSAM's preintegration of a block of at least one sample, around the biases of `block`.

    What gaps add to the noise is spread over the block as white noise of the same total. Told how W turns, GTSAM 4.3
    predicts what `imu.predict` does, but takes W to turn about its origin: the centrifugal force that this adds at
    p_WB_W, where the block begins, is part of gravity already, and is taken off it here.
    """
    g, b = rig[0], block[0]
    held_s = float(imu["held_s"] @ imu["dt_s"]) / float(b["T"])
    gyro_var, accel_var = g["gyro_density"] ** 2, g["accel_density"] ** 2
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(g["gravity"])
    params.setGyroscopeCovariance((gyro_var + HELD_RATE**2 * held_s) * np.eye(3))
    params.setAccelerometerCovariance((accel_var + HELD_ACCEL**2 * held_s) * np.eye(3))
    params.setIntegrationCovariance(INTEGRATION_DENSITY**2 * np.eye(3))
    accel_walk, gyro_walk = (max(g[f"{s}_walk"], LEAST_WALK * g[f"{s}_density"]) for s in ("accel", "gyro"))
    params.setBiasAccCovariance(accel_walk**2 * np.eye(3))
    params.setBiasOmegaCovariance(gyro_walk**2 * np.eye(3))
    if b["w_CW_W"].any():
        params.setOmegaCoriolis(b["w_CW_W"])
        params.n_gravity = params.n_gravity + np.cross(b["w_CW_W"], np.cross(b["w_CW_W"], p_WB_W))
    bias = gtsam.imuBias.ConstantBias(g["R_BI"] @ b["b_a"], g["R_BI"] @ b["b_g"])
    preintegrated = gtsam.PreintegratedCombinedMeasurements(params, bias)
    accel, gyro, dts = equivalent_samples(imu, before, rig, block)
    for f, w, dt in zip(accel, gyro, dts.tolist(), strict=True):
        preintegrated.integrateMeasurement(f, w, dt)
    return preintegrated


@inner
def fill_state(pose: Array, v_WB_W: Array, bias: Array, R_BI: Array, state: NDArray[Any]) -> None:
    """Fill a STATE record, but for P, from GTSAM's pose (4, 4), velocity and bias (6,)."""
    s = state[0]
    for i in range(3):
        s.p_WB_W[i], s.v_WB_W[i], s.b_a[i], s.b_g[i] = pose[i, 3], v_WB_W[i], 0.0, 0.0
        for j in range(3):
            s.R_WB[i, j] = pose[i, j]
            s.b_a[i] += R_BI[j, i] * bias[j]
            s.b_g[i] += R_BI[j, i] * bias[OF_GYRO + j]


@compiled
def by_gtsam(n: int, H: Array, pose: Array, R_BI: Array) -> tuple[Array, Array, Array]:
    """Split n rows of a Jacobian by our error state into those by GTSAM's pose, velocity and bias."""
    H_x, H_v, H_b = np.zeros((n, 6)), np.empty((n, 3)), np.zeros((n, 6))
    for i in range(n):
        for j in range(3):
            H_x[i, j], H_v[i, j] = H[i, THETA_0 + j], H[i, VELOCITY_0 + j]
            for k in range(3):
                H_x[i, OF_PLACE + j] += pose[k, j] * H[i, POSITION_0 + k]
                H_b[i, j] += R_BI[j, k] * H[i, ACCEL_BIAS_0 + k]
                H_b[i, OF_GYRO + j] += R_BI[j, k] * H[i, GYRO_BIAS_0 + k]
    return H_x, H_v, H_b


@compiled
def _linearise(
    reading: NDArray[Any],
    block: NDArray[Any],
    carried: bool,
    pose: Array,
    v_WB_W: Array,
    bias: Array,
    rig: NDArray[Any],
) -> tuple[Array, Array, Array, Array]:
    """Residual of a reading, carried over `block` first, and its Jacobians by the pose, velocity and bias of i."""
    state, R_BI = np.empty(1, STATE), rig[0].R_BI[:]
    r, H, H_i, C, F = np.empty(3), np.empty((3, DIM)), np.empty((3, DIM)), np.empty((3, 3)), np.empty((DIM, DIM))
    fill_state(pose, v_WB_W, bias, R_BI, state)
    identity(F)
    if carried:
        predict(block, state, rig[0].gravity, F, state)
    n = measure(reading, TOP, state, rig, r, H, C)
    rows_times(n, H, F, H_i)
    H_x, H_v, H_b = by_gtsam(n, H_i, pose, R_BI)
    return r[:n].copy(), H_x, H_v, H_b


@compiled
def _carried_covariance(reading: NDArray[Any], block: NDArray[Any], state: NDArray[Any], rig: NDArray[Any]) -> Array:
    """Covariance of a reading's residual, with the noise of the block that carries the keyframe to it."""
    F, Q, end = np.empty((DIM, DIM)), np.empty((DIM, DIM)), state.copy()
    r, H, HQ, C = np.empty(3), np.empty((3, DIM)), np.empty((3, DIM)), np.empty((3, 3))
    predict(block, state, rig[0].gravity, F, end)
    process_noise(block, state[0].R_WB[:], Q)
    n = measure(reading, TOP, end, rig, r, H, C)
    rows_times(n, H, Q, HQ)
    cov = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            cov[i, j] = C[i, j]
            for k in range(DIM):
                cov[i, j] += HQ[i, k] * H[j, k]
    return cov


def _pose(values: gtsam.Values, key: int) -> Array:
    return values.atPose3(key).matrix()


def _bias(values: gtsam.Values, key: int) -> Array:
    return values.atConstantBias(key).vector()


READ: dict[str, Callable[[gtsam.Values, int], Array]] = {"x": _pose, "v": gtsam.Values.atVector, "b": _bias}
"""How a variable is read from GTSAM's values, by the letter of its key: pose (4, 4), velocity (3,), bias (6,)."""


def custom_factor(model: Any, keys: list[int], linearise: Callable[..., Linearised]) -> gtsam.CustomFactor:
    """Return a factor of ours on these keys.

    Args:
        model: GTSAM's noise model.
        keys: of poses, velocities and biases.
        linearise: given what `READ` has of each key, returns the residual and its Jacobians, one for each key; further
            ones are left out.
    """
    variables = [(READ[gtsam.Symbol(key).string()[0]], key) for key in keys]

    def callback(_: Any, values: gtsam.Values, jacobians: Any) -> Array:
        r, *H = linearise(*[read(values, key) for read, key in variables])
        if jacobians is not None:
            for k in range(len(keys)):
                jacobians[k] = H[k]
        return r

    return gtsam.CustomFactor(model, keys, staged("linearisation", callback))


@stage("linearisation")
def reading_factor(i: int, reading: NDArray[Any], rig: NDArray[Any]) -> gtsam.NonlinearFactor:
    """Return the factor of a reading that was true at keyframe i: GTSAM's own where it has one.

    Args:
        i: keyframe.
        reading: one READING row.
        rig: RIG record.

    Raises:
        ValueError: the reading is of no known kind.
    """
    row, g = reading[0], rig[0]
    if not 0 <= row["kind"] < len(SENSOR):
        raise unknown_kind(row["kind"])
    sigma = row["sigma"] * g["inflate"][row["kind"]]
    if row["kind"] == DEPTH:
        model = gtsam.noiseModel.Diagonal.Sigmas(np.array([np.inf, np.inf, sigma[0]]))
        return gtsam.GPSFactorArm(X(i), np.array([0.0, 0.0, row["z"][0]]), g["p_BP_B"], model)
    if row["kind"] == GPS:
        return gtsam.GPSFactorArm(X(i), row["z"][:3], g["p_BG_B"], gtsam.noiseModel.Diagonal.Sigmas(sigma))
    if row["kind"] == ATTITUDE:
        R_WB = row["z"].reshape(3, 3) @ g["R_BH"].T
        return gtsam.PoseRotationPrior3D(X(i), gtsam.Rot3(R_WB), gtsam.noiseModel.Diagonal.Sigmas(sigma))

    def linearise(pose: Array, v_WB_W: Array = ZERO) -> Linearised:
        return _linearise(reading, NO_BLOCK, False, pose, v_WB_W, NO_BIAS, rig)

    if row["kind"] == HEADING:
        return custom_factor(gtsam.noiseModel.Isotropic.Sigma(1, sigma[0]), [X(i)], linearise)
    assert row["kind"] == DVL, "a kind without a factor"
    measured = np.isfinite(sigma)
    cov = np.diag(sigma[measured] ** 2) + g["rate_cov"][np.ix_(measured, measured)]
    return custom_factor(gtsam.noiseModel.Gaussian.Covariance(cov), [X(i), V(i)], linearise)


@stage("linearisation")
def carried_factor(
    i: int, reading: NDArray[Any], block: NDArray[Any], at_i: NDArray[Any], rig: NDArray[Any]
) -> gtsam.CustomFactor:
    """Return the factor of a reading that was true after keyframe i: the block carries the keyframe to it.

    Args:
        i: keyframe.
        reading: one READING row.
        block: BLOCK record from the keyframe to the reading.
        at_i: STATE record at keyframe i, where the covariance is evaluated.
        rig: RIG record.
    """
    model = gtsam.noiseModel.Gaussian.Covariance(_carried_covariance(reading, block, at_i, rig))

    def linearise(pose: Array, v_WB_W: Array, bias: Array) -> Linearised:
        return _linearise(reading, block, True, pose, v_WB_W, bias, rig)

    return custom_factor(model, [X(i), V(i), B(i)], linearise)


@inner
def _split_pose(pose: Array) -> tuple[Array, Array]:
    """Return R_WB and p_WB_W of a pose (4, 4)."""
    R_WB, p_WB_W = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        p_WB_W[i] = pose[i, 3]
        for j in range(3):
            R_WB[i, j] = pose[i, j]
    return R_WB, p_WB_W


@compiled
def _linearise_displacement(pose_i: Array, pose_j: Array, dp_ij: Array) -> tuple[Array, Array, Array]:
    """Residual, and its Jacobians by the pose of i and that of j."""
    H_i, H_j, R_BI = np.empty((3, DIM)), np.empty((3, DIM)), np.empty((3, 3))
    identity(R_BI)  # biases are not involved
    (R_i, p_i), (_, p_j) = _split_pose(pose_i), _split_pose(pose_j)
    r = preintegrated_dvl_residual(R_i, p_i, p_j, dp_ij, H_i, H_j)
    return r, by_gtsam(len(H_i), H_i, pose_i, R_BI)[0], by_gtsam(len(H_j), H_j, pose_j, R_BI)[0]


@stage("linearisation")
def displacement_factor(i: int, j: int, dp_ij: Array, cov: Array) -> gtsam.CustomFactor:
    """Return the loose preintegrated-DVL factor between two keyframes; docs/conventions.md (6)."""

    def linearise(pose_i: Array, pose_j: Array) -> Linearised:
        return _linearise_displacement(pose_i, pose_j, dp_ij)

    return custom_factor(gtsam.noiseModel.Gaussian.Covariance(cov), [X(i), X(j)], linearise)


@compiled
def _linearise_tight_displacement(
    displacement: NDArray[Any], K: Array, pose_i: Array, pose_j: Array, bias: Array, R_BI: Array
) -> tuple[Array, Array, Array, Array]:
    """Residual, and its Jacobians by the pose of i, that of j, and the bias of i."""
    H_i, H_j, b_g = np.empty((3, DIM)), np.empty((3, DIM)), np.zeros(3)
    (R_i, p_i), (R_j, p_j) = _split_pose(pose_i), _split_pose(pose_j)
    for i in range(3):
        for j in range(3):
            b_g[i] += R_BI[j, i] * bias[OF_GYRO + j]
    r = tight_dvl_residual(R_i, p_i, b_g, R_j, p_j, displacement, K, H_i, H_j)
    H_x, _, H_b = by_gtsam(len(H_i), H_i, pose_i, R_BI)
    return r, H_x, by_gtsam(len(H_j), H_j, pose_j, R_BI)[0], H_b


@stage("linearisation")
def tight_displacement_factor(i: int, j: int, displacement: NDArray[Any], rig: NDArray[Any]) -> gtsam.CustomFactor:
    """Return the tight preintegrated-DVL factor: the displacement given the rotation and the gyro bias of keyframe i.

    Args:
        i, j: keyframes.
        displacement: DISPLACEMENT record from i to j.
        rig: RIG record.
    """
    K, cov = given_rotation(displacement[0]["N"])
    R_BI = rig[0]["R_BI"]

    def linearise(pose_i: Array, pose_j: Array, bias: Array) -> Linearised:
        return _linearise_tight_displacement(displacement, K, pose_i, pose_j, bias, R_BI)

    return custom_factor(gtsam.noiseModel.Gaussian.Covariance(cov), [X(i), X(j), B(i)], linearise)


@compiled
def _linearise_prior(
    mean: NDArray[Any], pose: Array, v_WB_W: Array, bias: Array, R_BI: Array
) -> tuple[Array, Array, Array, Array]:
    """Return r (15,), the invariant error of the state from the mean; and its Jacobians by pose, velocity and bias."""
    r, H, state = np.empty(DIM), np.empty((DIM, DIM)), np.empty(1, STATE)
    fill_state(pose, v_WB_W, bias, R_BI, state)
    local_invariant(mean, state, r)
    invariant_after_error(state, r, H)
    H_x, H_v, H_b = by_gtsam(len(H), H, pose, R_BI)
    return r, H_x, H_v, H_b


@stage("linearisation")
def prior_factor(prior: NDArray[Any], rig: NDArray[Any]) -> gtsam.CustomFactor:
    """Return the prior (a STATE record, its whole P) as one factor on keyframe 0, normal in the invariant error.

    So a velocity that is known in B stays known, whatever the heading turns out to be.
    """
    A = to_invariant(prior[0]["R_WB"].copy(), prior[0]["v_WB_W"].copy())
    model = gtsam.noiseModel.Gaussian.Covariance(A @ prior[0]["P"] @ A.T)

    def linearise(pose: Array, v_WB_W: Array, bias: Array) -> Linearised:
        return _linearise_prior(prior, pose, v_WB_W, bias, rig[0]["R_BI"])

    return custom_factor(model, [X(0), V(0), B(0)], linearise)


def linearise_alike(state: NavState, R_BI: Array) -> tuple[Callable[[int], None], Callable[[int], None]]:
    """Return two functions that linearise a factor n times: ours of a displacement, and a native one of that size.

    The native one is GTSAM's of a point in two frames; both are 3 × 12. For `fathom timing`.

    Args:
        state: where both are linearised.
        R_BI: the IMU's mounting.
    """
    values = gtsam.Values()
    for i in range(2):
        insert_state(values, i, state, R_BI)
        values.insert(L(i), np.ones(3))
    cov = 1e-4 * (np.eye(3) + 0.1)
    ours = displacement_factor(0, 1, np.ones(3), cov)
    native = gtsam.ReferenceFrameFactorPoint3Pose3(L(0), X(0), L(1), gtsam.noiseModel.Gaussian.Covariance(cov))
    assert {factor.linearize(values).jacobian()[0].shape for factor in (ours, native)} == {(3, 12)}

    def many(factor: Any, n: int) -> None:
        for _ in range(n):
            factor.linearize(values)

    return partial(many, ours), partial(many, native)


def insert_state(values: gtsam.Values, i: int, state: NavState, R_BI: Array) -> None:
    """Add a state to GTSAM's values as keyframe i."""
    values.insert(X(i), gtsam.Pose3(gtsam.Rot3(state.R_WB), state.p_WB_W))
    values.insert(V(i), state.v_WB_W)
    values.insert(B(i), gtsam.imuBias.ConstantBias(R_BI @ state.b_a, R_BI @ state.b_g))


def as_state(pose: gtsam.Pose3, v_WB_W: Array, bias: gtsam.imuBias.ConstantBias, R_BI: Array) -> NavState:
    """Return GTSAM's three variables of a keyframe as a state of ours."""
    T_WB, b_B = pose.matrix(), bias.vector()
    return NavState(T_WB[:3, :3], T_WB[:3, 3], v_WB_W, R_BI.T @ b_B[:3], R_BI.T @ b_B[3:])


def as_covariance(joint: Array, R_WB: Array, R_BI: Array, R_WB_linearised: Array | None = None) -> Array:
    """Return GTSAM's joint covariance of (pose, velocity, bias) as that of our error state, (15, 15), at R_WB.

    Rotation and velocity are taken for normal in the invariant error, whose second order is added (`spread_velocity`).

    Args:
        joint: (15, 15) in GTSAM's tangents.
        R_WB: the estimate's.
        R_BI: the IMU's mounting.
        R_WB_linearised: where the factors were linearised, if not at the estimate: iSAM2 leaves that be until a
            variable has moved by a threshold. A factor sees a position move in the axes of this
            rotation: an unmeasured metre, in axes a hundredth of a radian off, would outweigh a depth reading.
    """
    R_at = R_WB if R_WB_linearised is None else R_WB_linearised
    G = np.zeros((DIM, DIM))
    G[THETA, THETA], G[VELOCITY, VELOCITY] = right_jacobian(log(product(R_at.T, R_WB))), np.eye(3)
    G[POSITION, POSITION] = R_at
    G[ACCEL_BIAS, ACCEL_BIAS] = G[GYRO_BIAS, GYRO_BIAS] = R_BI.T
    P = G @ joint @ G.T
    spread_velocity(P, R_WB)
    return P


@contextmanager
def gtsam_failures() -> Iterator[None]:
    """Turn what GTSAM throws into `Diverged`, on one line, its keys by name; the smoother is then unusable."""
    try:
        yield
    except Diverged:
        raise
    except (RuntimeError, ValueError, IndexError) as error:
        named = re.sub(r"\b\d{10,}\b", lambda key: gtsam.Symbol(int(key.group())).string(), message_of(error))
        raise Diverged(f"GTSAM: {named[:300]}") from None
