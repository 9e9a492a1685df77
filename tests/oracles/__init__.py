"""Independent oracles in plain NumPy, double precision: textbook forms that share no code with the library."""

from __future__ import annotations

import numpy as np


def exponential(M):
    """The exponential of a matrix by its Taylor series on a matrix halved until it is small."""
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(M).sum(axis=1).max(), 1e-300)))) + 1)
    small = M / 2**halvings
    result = term = np.eye(len(M))
    for k in range(1, 30):
        term = term @ small / k
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result


def van_loan(A, noise, dt):
    """F and Q of dx = A x dt + dW with power density `noise` (Van Loan 1978), by halving dt and doubling back.

    Without the halving the exponential of −A dt overflows what is left of Q for long steps.
    """
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(A).sum(axis=1).max() * dt, 1e-300)))) + 1)
    n = len(A)
    block = np.block([[-A, noise], [np.zeros((n, n)), A.T]]) * (dt / 2**halvings)
    result = exponential(block)
    F = result[n:, n:].T
    Q = F @ result[:n, n:]
    for _ in range(halvings):
        F, Q = F @ F, F @ Q @ F.T + Q
    return F, (Q + Q.T) / 2


def normal_log_density(r, S):
    """The log density of N(0, S) at r; zero for no numbers."""
    if len(r) == 0:
        return 0.0
    _, log_det = np.linalg.slogdet(S)
    return -0.5 * (r @ np.linalg.solve(S, r) + log_det + len(r) * np.log(2 * np.pi))


def kalman(transitions, H, R, readings, seen, mean, cov):
    """The textbook filter, one row after another, with the missing channels' rows really deleted.

    `transitions`: (F, Q) of each row; `readings`, `seen`: (T, m). Means, covariances, log-likelihoods and NIS per row.
    """
    out = []
    for (F, Q), z, s in zip(transitions, readings, seen, strict=True):
        mean, cov = F @ mean, F @ cov @ F.T + Q
        h, r = H[s], R[np.ix_(s, s)]
        innovation, S = z[s] - h @ mean, h @ cov @ h.T + r
        nis = innovation @ np.linalg.solve(S, innovation) if s.any() else 0.0
        log_likelihood = normal_log_density(innovation, S)
        K = cov @ h.T @ np.linalg.inv(S)
        mean, cov = mean + K @ innovation, cov - K @ S @ K.T
        out.append((mean, cov, log_likelihood, nis))
    return tuple(np.array(column) for column in zip(*out, strict=True))


def joint_conditioning(transitions, H, R, readings, seen, mean, cov, until=None):
    """Moments without recursion: the joint Gaussian of all states and readings, conditioned.

    Row t's moments condition the joint of every state on all readings seen up to row t, or up to row until[t]; its
    log-likelihood is the log density of those readings less that of the readings of the row before.
    """
    T, n = len(transitions), len(mean)
    # Every state is a linear map of (first state, all process noises), whose covariance is block diagonal.
    size = n * (T + 1)
    source = np.zeros((size, size))
    source[:n, :n] = cov
    maps, current, means = [], np.eye(n, size), [mean]
    for t, (F, Q) in enumerate(transitions):
        source[n * (t + 1) : n * (t + 2), n * (t + 1) : n * (t + 2)] = Q
        current = F @ current + np.eye(n, size, n * (t + 1))
        maps.append(current)
        means.append(F @ means[-1])
    out, before = [], 0.0
    for t in range(T):
        rows = [(k, j) for k in range((t if until is None else until[t]) + 1) for j in np.flatnonzero(seen[k])]
        L = np.array([H[j] @ maps[k] for k, j in rows]).reshape(len(rows), size)
        same_row = np.array([[a[0] == b[0] for b in rows] for a in rows]).reshape(len(rows), len(rows))
        noise = np.where(same_row, R[np.ix_([j for _, j in rows], [j for _, j in rows])], 0.0)
        S = L @ source @ L.T + noise
        r = np.array([readings[k, j] - H[j] @ means[k + 1] for k, j in rows])
        cross = maps[t] @ source @ L.T
        gain = cross @ np.linalg.inv(S)
        density = normal_log_density(r, S)
        out.append((means[t + 1] + gain @ r, maps[t] @ source @ maps[t].T - gain @ cross.T, density - before))
        before = density
    return tuple(np.array(column) for column in zip(*out, strict=True))


def cramer_rao(transitions, information, cov):
    """The posterior Cramér–Rao bound of each row (Tichavský 1998), for linear motion and a mean information a row.

    `information`: (T, n, n), the expected information of each row's reading over true states. In covariance form,
    for the process noise of a beam has rank 2 of 4.
    """
    bounds = []
    for (F, Q), J in zip(transitions, information, strict=True):
        cov = F @ cov @ F.T + Q
        cov = np.linalg.inv(np.linalg.inv(cov) + J)
        bounds.append(cov)
    return np.array(bounds)


def beam_transition(dt, sigma_a):
    """F and Q of equations (5), (6): angles first, then rates."""
    eye = np.eye(2)
    F = np.block([[eye, dt * eye], [0 * eye, eye]])
    G = np.vstack([0.5 * dt**2 * eye, dt * eye])
    return F, sigma_a**2 * G @ G.T


def beam_jacobian(wavenumbers, azimuth, elevation):
    """The phases (n,) of equation (9) and their hand-derived derivatives with respect to both angles (n, 2)."""
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    slope = np.array(
        [[np.cos(azimuth) * np.cos(elevation), -np.sin(azimuth) * np.sin(elevation)], [0.0, np.cos(elevation)]]
    )
    return wavenumbers @ direction, wavenumbers @ slope


def paper_beam_filter(wavenumbers, sigma_a, sigma_p, dts, phases, seen, mean, cov):
    """The paper's EKF (4)–(19) on all wrapped differences of the antennas seen, by the pseudo-inverse of R.

    Means, covariances and log densities per row, the last with pseudo-determinants over the differences' range.
    """
    out = []
    for dt, z, s in zip(dts, phases, seen, strict=True):
        F, Q = beam_transition(dt, sigma_a)
        mean, cov = F @ mean, F @ cov @ F.T + Q
        k, z = wavenumbers[s], z[s]
        pairs = [(i, j) for i in range(len(z)) for j in range(i)]
        log_likelihood = 0.0
        if pairs:
            D = np.array([np.eye(len(z))[i] - np.eye(len(z))[j] for i, j in pairs])
            predicted, G = beam_jacobian(k, mean[0], mean[1])
            innovation = np.angle(np.exp(1j * (D @ (z - predicted))))
            H = np.hstack([D @ G, np.zeros((len(pairs), 2))])
            S = H @ cov @ H.T + sigma_p**2 * D @ D.T
            inverse = np.linalg.pinv(S, rcond=1e-10, hermitian=True)
            values = np.linalg.eigvalsh(S)[-(len(z) - 1) :]
            log_likelihood = -0.5 * (innovation @ inverse @ innovation + np.sum(np.log(2 * np.pi * values)))
            K = cov @ H.T @ inverse
            mean, cov = mean + K @ innovation, cov - K @ S @ K.T
        out.append((mean, cov, log_likelihood))
    return tuple(np.array(column) for column in zip(*out, strict=True))


def distances_to_path(points, knots):
    """The distance of each point (N, 2) from the polyline of `knots` (K, 2), segment by segment."""
    starts, segments = knots[:-1], np.diff(knots, axis=0)
    squares = np.maximum(np.einsum("kd,kd->k", segments, segments), np.finfo(float).tiny)
    nearest = np.full(len(points), np.inf)
    for start, segment, square in zip(starts, segments, squares, strict=True):
        deviation = points - start
        deviation = deviation - np.clip(deviation @ segment / square, 0.0, 1.0)[:, None] * segment
        nearest = np.minimum(nearest, np.einsum("nd,nd->n", deviation, deviation))
    return np.sqrt(nearest)
