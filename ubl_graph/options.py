"""Every knob of the smoother, with its unit, its default and the reason for it.

The attribute docstrings are the documentation; `docs/mission-file.md` shows the same keys as
they stand under `[options]` in a mission file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from ubl_graph.errors import ConfigurationError

Motion = Literal["constant_velocity", "constant_acceleration"]
#: In place of a value: `smooth` chooses it by the data's own likelihood.
Auto = Literal["auto"]
Loss = Literal["cauchy", "huber", "geman_mcclure", "dcs", "tukey", "none"]
Rays = Literal["auto", "straight", "eigenray"]
Solver = Literal["auto", "gtsam", "banded"]
OnlineEngine = Literal["lm", "isam2"]
Node = Literal["point", "pose2", "pose3"]
OdometryNoise = Literal["given", "growing", "both"]
Covariance = Literal["formal", "calibrated"]
Noise = Literal["given", "inflated"]

#: Options whose name begins so may be zero.
MAY_VANISH = (
    "dvl_",
    "sound_speed_",
    "current_walk",
    "clock_",
    "heading_bias_",
    "gyro_",
    "odometry_",
    "range_bias_",
    "lever_arm_",
)
#: What the options that are left to the data say, and which ones may.
AUTO: Auto = "auto"
AUTOMATIC = ("motion", "acceleration_psd", "jerk_psd", "travel_time_sigma", "sound_speed_walk")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a mission. All are optional; quantities are SI unless the name ends in a unit.

    Raises
    ------
    ConfigurationError
        Where a value is of the wrong kind, not finite, or outside its range.
    """

    node: Node = "point"
    """What a node of the graph is. A point moves with the attitude held at what the reference says,
    but for a heading bias; a pose has its attitude estimated: in the plane (east, north, heading)
    or in space. docs/nodes.md says which to take when."""

    motion: Motion | Auto = "constant_velocity"
    """Motion prior between nodes: white noise on acceleration or on jerk; "auto" takes the one
    that makes the data more likely."""

    acceleration_psd: float | Auto = 2e-3
    """Horizontal acceleration noise of the constant-velocity prior, m^2/s^3. After a time t an
    unaided velocity has drifted by sqrt(psd t): 0.45 m/s in 100 s. "auto" chooses it, and the
    vertical one where that is left out, by marginal likelihood."""

    vertical_acceleration_psd: float | None = None
    """The same for the vertical; left out, it equals the horizontal one (for a surface vessel,
    which heaves, a garpos mission takes 0.3)."""

    jerk_psd: float | Auto = 1e-5
    """Horizontal jerk noise of the constant-acceleration prior, m^2/s^5; "auto" as above."""

    vertical_jerk_psd: float | None = None
    """The same for the vertical; left out, it equals the horizontal one."""

    speed_sigma: float = 1000.0
    """What is known of the first velocity before any measurement: zero within this, m/s. So wide
    that it pulls no estimate; it only keeps the equations regular."""

    loss: Loss = "cauchy"
    """Robust loss on the acoustic ranges; its width gives 95 % efficiency on normal noise."""

    rays: Rays = "auto"
    """Travel times along straight lines at the harmonic-mean speed, or along eigenrays; auto
    takes eigenrays where the sound speed is a profile."""

    travel_time_sigma: float | Auto = 1e-4
    """Standard deviation of a travel time where the data give none, s. "auto" multiplies those of
    all travel times, 1e-4 s where the data give none, by a factor that it finds."""

    estimate_sound_speed: bool = True
    """Whether a slowly varying scale of the sound speed is estimated."""

    sound_speed_sigma: float | None = None
    """Relative standard deviation of the sound speed at a segment's start. Left out: 1e-3 for a
    profile (1.5 m/s), 5e-3 for a constant (7.5 m/s, the spread of column means at sea)."""

    sound_speed_walk: float | Auto = 2e-6
    """Random walk of the relative sound speed, 1/sqrt(s): 1.2e-4 (0.18 m/s) in an hour; "auto" as
    above."""

    estimate_beacons: bool = False
    """False: beacons are constants. True: unknowns with their `sigma` as prior."""

    range_bias_sigma: float = 0.0
    """Standard deviation of a constant error of each beacon's ranges, m (its turnaround, how it
    detects a ping); 0 leaves the states out."""

    lever_arm_sigma: float = 0.0
    """Standard deviation of each component of the transducer's lever arm, m; 0 leaves the state
    out."""

    estimate_current: bool = False
    """Whether the water current is estimated; needed for water-track velocities."""

    current_sigma: float = 0.5
    """Standard deviation of each component of the current at the start, m/s."""

    current_walk: float = 2e-3
    """Random walk of the current, m/s per sqrt(s): 0.12 m/s in an hour."""

    clock_offset_sigma: float = 60.0
    """Standard deviation of the clock offset (vehicle - beacon) at the start, s: nothing is known
    but what a record may hold."""

    clock_drift_sigma: float = 1e-3
    """Standard deviation of the clock drift at the start, s/s: a hundred times a bare crystal's."""

    clock_walk: float = 1e-7
    """Random walk of the clock offset beyond its drift, s per sqrt(s)."""

    clock_drift_walk: float = 1e-10
    """Random walk of the clock drift, s/s per sqrt(s)."""

    dvl_scale_sigma: float = 3e-3
    """Standard deviation of the DVL's scale error; 0 leaves the state out."""

    dvl_bias_sigma: float = 2e-3
    """Standard deviation of each component of the DVL's bias, m/s; 0 leaves the state out."""

    dvl_misalignment_sigma_deg: float = 0.5
    """Standard deviation of each angle between DVL and attitude reference, degrees; 0 leaves the
    state out. Lasting errors of roll and pitch add to it by the attitude records' sigma; that of
    the heading is a state of its own, `heading_bias`, with that sigma."""

    heading_bias_sigma_deg: float | None = None
    """Standard deviation of what the heading reference lastingly reads too far clockwise, degrees.
    Left out: the attitude records' own sigma; 5 for a vehicle that has heading records only."""

    heading_bias_walk_deg: float = 0.0
    """Random walk of the heading bias, degrees per sqrt(hour); 0 keeps it constant."""

    attitude_noise_deg: float = 0.1
    """White part of an attitude record's error, degrees, where the attitude is estimated (pose
    nodes); the lasting part is the heading bias."""

    angular_acceleration_psd: float = 1e-3
    """Noise of the turning rates of pose nodes, rad^2/s^3: in 10 s a rate changes by 0.1 rad/s."""

    gyro_bias_sigma: float = 1e-4
    """Standard deviation of the angular rates' constant bias, rad/s (20 degrees an hour); 0 leaves
    the state out."""

    odometry_noise: OdometryNoise = "given"
    """Noise of odometry records: their own covariance where they have one, or one that grows with
    way and time by the four numbers below (the only one of records without any), or their sum."""

    odometry_way_noise: float = 0.02
    """Odometry's displacement noise that grows with the way, m per sqrt(m)."""

    odometry_time_noise: float = 1e-3
    """Odometry's displacement noise that grows with time, m per sqrt(s)."""

    odometry_way_turn_noise_deg: float = 0.1
    """Odometry's turning noise that grows with the way, degrees per sqrt(m)."""

    odometry_time_turn_noise_deg: float = 0.01
    """Odometry's turning noise that grows with time, degrees per sqrt(s)."""

    odometry_scale_sigma: float = 0.01
    """Standard deviation of the odometry's scale error; 0 leaves the state out."""

    odometry_turn_bias_sigma_deg: float = 0.03
    """Standard deviation of what the odometry turns too far clockwise, degrees per second (100
    degrees an hour: a small gyro that has been zeroed); 0 leaves the state out."""

    start_window: float = 80.0
    """Length of the windows in which a start is searched, s."""

    solver: Solver = "auto"
    """GTSAM on the factor graph, or the banded normal equations; both take the same steps to the
    same answer, the banded solver some 30 times faster. Auto solves on the fast path and has GTSAM
    confirm the answer up to 5 000 nodes (8 000 rows where nodes are poses); more than 64 shared
    unknowns GTSAM solves alone."""

    covariance: Covariance = "formal"
    """Covariances as the stated noise makes them, or multiplied by what held-out pings ask for
    (docs/consistency.md)."""

    noise: Noise = "given"
    """"inflated" smooths twice: the second time with the noise of ranges, motion or odometry, and
    sound speed multiplied by what held-out pings ask for, never by less than 1."""

    node_spacing: float | None = None
    """Nodes on a regular grid of this spacing, s. Left out: offline at the measurements' times,
    online on the grid that the noise asks for (1 s at the defaults)."""

    lag: float = 80.0
    """Length of the online estimator's window, s; a record that comes later is refused."""

    engine: OnlineEngine = "lm"
    """Online: the window re-solved by the banded solver, or GTSAM's incremental smoother."""

    max_iterations: int = 100
    """Levenberg-Marquardt iterations after which a solve counts as not converged."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            kind = str(f.type)
            if kind.startswith("float"):
                self._check_number(f.name, value, optional="None" in kind, auto="Auto" in kind)
        choices: dict[str, tuple[str, ...]] = {
            "motion": ("constant_velocity", "constant_acceleration", AUTO),
            "loss": ("cauchy", "huber", "geman_mcclure", "dcs", "tukey", "none"),
            "rays": ("auto", "straight", "eigenray"),
            "solver": ("auto", "gtsam", "banded"),
            "engine": ("lm", "isam2"),
            "node": ("point", "pose2", "pose3"),
            "odometry_noise": ("given", "growing", "both"),
            "covariance": ("formal", "calibrated"),
            "noise": ("given", "inflated"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ConfigurationError(
                    f"'{getattr(self, name)}' is not one of {', '.join(allowed)}",
                    field=f"options.{name}",
                )
        for f in fields(self):
            value = getattr(self, f.name)
            if str(f.type) == "bool" and not isinstance(value, bool):
                raise ConfigurationError(
                    f"{value!r} is neither True nor False", field=f"options.{f.name}"
                )
        most = self.max_iterations
        if type(most) is not int or most < 1:
            raise ConfigurationError(
                f"{most!r} is no number of iterations",
                "give 1 or more",
                field="options.max_iterations",
            )

    def _check_number(
        self, name: str, value: float | str | None, *, optional: bool, auto: bool
    ) -> None:
        if (value is None and optional) or (value == AUTO and auto):
            return
        may_vanish = name.startswith(MAY_VANISH)
        if (
            isinstance(value, bool)
            or not isinstance(value, (int, float))
            or not math.isfinite(value)
            or value < 0.0
            or (value == 0.0 and not may_vanish)
        ):
            kind = "non-negative" if may_vanish else "positive"
            raise ConfigurationError(
                f"{value} is not a {kind} number" + (f" or '{AUTO}'" if auto else ""),
                field=f"options.{name}",
            )

    @property
    def automatic(self) -> tuple[str, ...]:
        """Names of the options that are left to the data ("auto")."""
        return tuple(name for name in AUTOMATIC if getattr(self, name) == AUTO)

    @property
    def settled(self) -> Options:
        """The same with the defaults in place of what is left to the data."""
        defaults = {f.name: f.default for f in fields(self)}
        return replace(self, **{name: defaults[name] for name in self.automatic})

    @property
    def vertical_psd(self) -> float:
        """Vertical noise density of the motion prior in force, m^2/s^3 or m^2/s^5."""
        given = (
            self.vertical_acceleration_psd if self.is_constant_velocity else self.vertical_jerk_psd
        )
        return self.horizontal_psd if given is None else given

    @property
    def horizontal_psd(self) -> float:
        """Horizontal noise density of the motion prior in force, m^2/s^3 or m^2/s^5."""
        return self.number("acceleration_psd" if self.is_constant_velocity else "jerk_psd")

    @property
    def is_constant_velocity(self) -> bool:
        """Whether the motion prior is white noise on acceleration, not on jerk."""
        self._refuse_automatic("motion")
        return self.motion == "constant_velocity"

    def number(self, name: str) -> float:
        """Value of an option that may be left to the data.

        Raises
        ------
        ConfigurationError
            Where it is: only `smooth` chooses, from a whole mission.
        """
        self._refuse_automatic(name)
        return float(getattr(self, name))

    def require_settled(self) -> None:
        """Refuse options that only a whole mission of one vehicle can have.

        Raises
        ------
        ConfigurationError
            Where something is left to the data, or held-out pings are asked for.
        """
        for name in self.automatic:
            self._refuse_automatic(name)
        for name, usual in (("covariance", "formal"), ("noise", "given")):
            if getattr(self, name) != usual:
                raise ConfigurationError(
                    f"'{getattr(self, name)}' is for whole missions of one vehicle",
                    f"leave it out, or give '{usual}'",
                    field=f"options.{name}",
                )

    def _refuse_automatic(self, name: str) -> None:
        if getattr(self, name) == AUTO:
            raise ConfigurationError(
                f"'{AUTO}' is for whole missions",
                "smooth a recorded one with it and give the value that result.json names",
                field=f"options.{name}",
            )
