"""What held-out pings say of a result's covariances."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

#: Sigmas that are off by less than this factor agree with the pings, however many these are.
NEGLIGIBLE = 1.2
#: A lasting error of the travel times of less than this is none worth naming, s: 4 mm two-way.
NEGLIGIBLE_ERROR = 5e-6
#: So many standard deviations of the factor's logarithm are its uncertainty.
CONFIDENT = 2.0
#: Where nothing is known the factor may be anything up to e to this.
LARGEST = 50.0


@dataclass(frozen=True)
class Whiteness:
    """Whether neighbouring residuals of one beacon are independent.

    Attributes
    ----------
    count : int
        Residuals, of pings that count for more than half.
    lag_one : float
        Correlation of neighbours, -1 to 1.
    statistic, p_value : float
        Ljung and Box's Q over the lags, and the probability of a larger one were they independent.
    lags : int
        How many.
    """

    count: int
    lag_one: float
    statistic: float
    p_value: float
    lags: int


@dataclass(frozen=True)
class Consistency:
    """Whether sigmas are true, by pings that were kept out and predicted.

    Attributes
    ----------
    factor : float
        By which the sigmas of the track are to be multiplied to be true; 1 where nothing is known.
    log_sigma : float
        Standard deviation of its logarithm.
    noise : dict of str to float
        The same for the stated noise of `ranges`, `motion` (or odometry) and `medium` (how sound
        speed and clock wander). What is below 1 counts as 1 in `factor`, but for the ranges.
    beacon_error : float
        Standard deviation of a lasting error of each beacon's travel times, s, which no sigma
        states.
    shares : dict of str to float
        How much of the track's stated variance comes from each source; of `beacons` how much a
        lasting error of one ping's sigma would add.
    blocks, pings : int
        Blocks of time, and pings, that were kept out and predicted.
    nis : float
        Mean squared Mahalanobis length of what was predicted, by its number of components: 1 where
        all sigmas are true.
    coverage : float
        Share of the predictions inside their 95 % interval.
    whiteness : dict of str to Whiteness
        Of the residuals, by beacon.
    left_out : tuple of str
        Segments whose track is not determined; they have no part in it.
    trouble : str
        Why nothing is known; empty where there is a verdict.
    applied : bool
        Whether the covariances of the result have been multiplied by the square of `factor`.
    """

    factor: float = 1.0
    log_sigma: float = float("inf")
    noise: dict[str, float] = field(default_factory=dict[str, float])
    beacon_error: float = 0.0
    shares: dict[str, float] = field(default_factory=dict[str, float])
    blocks: int = 0
    pings: int = 0
    nis: float = float("nan")
    coverage: float = float("nan")
    whiteness: dict[str, Whiteness] = field(default_factory=dict[str, Whiteness])
    left_out: tuple[str, ...] = ()
    trouble: str = ""
    applied: bool = False

    @property
    def interval(self) -> tuple[float, float]:
        """Where the factor lies with 95 % probability."""
        spread = math.exp(min(CONFIDENT * self.log_sigma, LARGEST))
        return self.factor / spread, self.factor * spread

    @property
    def agrees(self) -> bool:
        """Whether the sigmas are as true as can be told."""
        low, high = self.interval
        return not self.trouble and (self._is_negligible or low <= 1.0 <= high)

    @property
    def _is_negligible(self) -> bool:
        return 1.0 / NEGLIGIBLE < self.factor < NEGLIGIBLE

    @property
    def verdict(self) -> str:
        """All this in a sentence."""
        if self.trouble:
            return f"no verdict on the sigmas: {self.trouble}"
        low, high = self.interval
        told = f"by {self.pings} held-out pings in {self.blocks} blocks"
        if self._is_negligible:
            text = (
                f"sigmas agree with held-out pings (factor {self.factor:.2f}, {low:.2f} to "
                f"{high:.2f}, {told})"
            )
        elif self.agrees:
            text = (
                f"sigmas may be off by a factor of {self.factor:.1f} or not at all "
                f"({low:.2f} to {high:.2f}, {told})"
            )
        elif self.factor > 1.0:
            text = (
                f"sigmas are {self.factor:.1f} times too small ({low:.1f} to {high:.1f}, {told}); "
                f"{self._causes()}"
            )
        else:
            text = (
                f"sigmas are {1.0 / self.factor:.1f} times too large "
                f"({1.0 / high:.1f} to {1.0 / low:.1f}, {told})"
            )
        if self.left_out:
            text += f"; not judged: {', '.join(self.left_out)}"
        return text + ("; covariances are scaled by it" if self.applied else "")

    def _causes(self) -> str:
        words = {"ranges": "range noise", "motion": "motion noise", "medium": "sound speed's walk"}
        causes = [
            f"{words[name]} is {value:.1f} times what was stated"
            for name, value in self.noise.items()
            if value > NEGLIGIBLE
        ]
        if self.beacon_error > NEGLIGIBLE_ERROR:
            causes.append(
                f"travel times of a beacon are lastingly off by {1e3 * self.beacon_error:.2g} ms"
            )
        return ", ".join(causes)
