"""One beacon passed by a vehicle whose odometry is exact, and the posterior of the side it is on.

The way is a leg, an arc of four seconds and a second leg. The oracle knows nothing of the library:
it sums the likelihood of the travel times over a grid of starts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile
from ubl_graph.sim import Sea, Truth, ahrs, dvl, pressure, two_way_pings

SOUND = 1500.0
PROFILE = SoundSpeedProfile.constant(SOUND)
SPEED, ARC = 2.0, 4.0
#: Nothing is to be estimated but the track.
EXACT = Options(
    dvl_scale_sigma=0.0,
    dvl_bias_sigma=0.0,
    dvl_misalignment_sigma_deg=0.0,
    heading_bias_sigma_deg=0.0,
    estimate_sound_speed=False,
)


@dataclass(frozen=True)
class Pass:
    """A vehicle that passes a beacon and turns.

    Attributes
    ----------
    angle, course : float
        By how much it turns to starboard, and its first course; rad.
    leg, off : float
        Length of each leg, and distance of the beacon from the first one, m.
    above : float
        Height over the beacon, m.
    side : float
        1 where it passes to starboard of the beacon (side A), -1 to port.
    """

    angle: float
    course: float = 0.0
    leg: float = 50.0
    off: float = 20.0
    above: float = 7.0
    side: float = 1.0
    site: tuple[float, float] = (4.0, -2.5)

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors (east, north) along the first leg, and to starboard of it."""
        s, c = np.sin(self.course), np.cos(self.course)
        return np.array([s, c]), np.array([c, -s])

    def way(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement (M, 2) since the start, m, and heading (M,), rad, at times (M,)."""
        t = np.atleast_1d(np.asarray(t, dtype=np.float64))
        first = self.leg / SPEED - ARC / 2.0
        rate = self.angle / ARC
        before, turning = np.minimum(t, first), np.clip(t - first, 0.0, ARC)
        after = np.maximum(t - first - ARC, 0.0)
        # sinc: sin(pi x) / (pi x), and the chord of an arc halves its angle.
        chord = SPEED * turning * np.sinc(rate * turning / (2.0 * np.pi))
        along, across = self.axes
        local = np.stack([0.0 * t, SPEED * before], axis=1)
        half = 0.5 * rate * turning
        local += chord[:, None] * np.stack([np.sin(half), np.cos(half)], axis=1)
        local += (SPEED * after)[:, None] * [np.sin(self.angle), np.cos(self.angle)]
        return local[:, :1] * across + local[:, 1:] * along, self.course + rate * turning

    def truth(self) -> Truth:
        along, across = self.axes
        begin = np.array(self.site) + self.side * self.off * across - self.leg * along

        def track(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            way, heading = self.way(t)
            place = np.column_stack([begin + way, np.full(len(way), -5.0)])
            velocity = SPEED * np.stack([np.sin(heading), np.cos(heading), 0.0 * heading], axis=1)
            return place, velocity

        return Truth((0.0, 2.0 * self.leg / SPEED), track)

    def beacon(self, name: str = "B1", along: float = 0.0, across: float = 0.0) -> Beacon:
        """A beacon at the site, or moved from there, m."""
        place = np.array(self.site) + along * self.axes[0] + across * self.axes[1]
        return Beacon(name, [*place, -5.0 - self.above])


def mission(
    way: Pass,
    rng: np.random.Generator,
    sigma: float,
    ping: float = 5.0,
    *,
    others: tuple[Beacon, ...] = (),
    velocity_noise: float = 0.0,
    **options: object,
) -> tuple[Mission, Truth]:
    """Ranges of `sigma` (m) every `ping` seconds; odometry without errors."""
    truth = way.truth()
    beacons = (way.beacon(), *others)
    end = truth.span[1]
    t = np.arange(0.0, end, 0.5)
    segment = Segment(
        two_way_range=two_way_pings(
            truth,
            beacons,
            np.arange(1.0, end - 4.0, ping),
            Sea(PROFILE),
            rng,
            sigma=2.0 * sigma / SOUND,
        ),
        velocity=dvl(truth, t, rng, sigma=1e-3, noise=velocity_noise),
        attitude=ahrs(truth, t),
        depth=pressure(truth, t, rng, noise=0.0),
    )
    return Mission((segment,), beacons, PROFILE, options=replace(EXACT, **options)), truth


def grid_weight(mission: Mission, way: Pass, step: float = 0.4) -> float:
    """Posterior probability of side A: the likelihood summed over a grid of starts."""
    pings = mission.segments[0].two_way_range
    along, across = way.axes
    legs = [way.way(t)[0] for t in (pings.t_transmit, pings.t_receive)]
    u = np.arange(-4.0 * way.off, 4.0 * way.off + 0.5 * step, step)
    v = np.arange(-way.leg - 60.0, -way.leg + 60.0 + 0.5 * step, step)
    starts = u[:, None, None] * across + v[None, :, None] * along
    cost = np.zeros(starts.shape[:2])
    for k in range(len(pings)):
        flight = 0.0
        for leg in legs:
            flat = starts + leg[k]
            flight = flight + np.sqrt((flat**2).sum(axis=2) + way.above**2) / SOUND
        cost += 0.5 * ((flight - pings.travel_time[k]) / float(np.ravel(pings.sigma)[0])) ** 2
    likelihood = np.exp(cost.min() - cost)
    return float(likelihood[u > 0.0].sum() / likelihood.sum())


def weight_of_a(hypotheses: tuple, way: Pass) -> float:
    """Weight of side A among hypotheses: by where their tracks begin."""
    across = way.axes[1]
    starts = [h.trajectory.position[0, :2] - way.site for h in hypotheses]
    return sum(h.weight for h, s in zip(hypotheses, starts, strict=True) if s @ across > 0.0)
