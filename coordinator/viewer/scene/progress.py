"""Logging of single events: steps, estimates, held-out torque and the state of the network."""

import math

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from coordinator.viewer.scene import entity_paths
from coordinator.viewer.scene.parameter_plot import NINETY_FIVE_SIGMAS, Estimate
from coordinator.viewer.scene.time_series import IntArray, envelope, send_scalars

LEGEND = "Band: 1σ. Thin lines and spheres: 95 %. Grey: the truth, if known."


def set_time(stream: rr.RecordingStream, t_ns: int) -> None:
    """Set the session time of everything that is logged next."""
    stream.set_time(entity_paths.TIMELINE, duration=np.timedelta64(t_ns, "ns"))


def log_phase(stream: rr.RecordingStream, text: str) -> None:
    """Log a step of the run, as a line of the log and as the heading of the view."""
    stream.log(entity_paths.PHASE_LOG, rr.TextLog(text, level=rr.TextLogLevel.INFO))
    stream.log(entity_paths.PHASE_NOW, rr.TextDocument(f"**{text}**\n\n{LEGEND}", media_type="text/markdown"))


def log_estimate(stream: rr.RecordingStream, estimate: Estimate, colour: entity_paths.Colour) -> None:
    """Log a value with its variance and its 95 % interval; without these if sigma is not finite.

    The viewer draws a line in a band of one sigma, and the ends of the interval as two thin lines.
    """
    known = math.isfinite(estimate.sigma)
    drawn = rr.Measurements(
        [estimate.value],
        # With None the variance of the previous estimate would remain valid.
        variances=[estimate.sigma**2] if known else [],
        units=estimate.units,
        names=estimate.serial,
        colors=[colour],
        widths=[2.0],
        # An estimate is valid until the next one.
        interpolation_mode="stepafter",
    )
    stream.log(entity_paths.estimate_path(estimate.name, estimate.serial), drawn)
    reach = NINETY_FIVE_SIGMAS * estimate.sigma if known else math.nan
    ends = [estimate.value - reach, estimate.value + reach]
    stream.log(entity_paths.interval_path(estimate.name, estimate.serial), rr.Scalars(ends))


def log_interval_style(
    stream: rr.RecordingStream, name: str, serial: str, colour: entity_paths.Colour
) -> None:
    """Log the static style of the ends of a parameter's interval."""
    style = rr.SeriesLines(
        names=["95 %: from", "95 %: to"],
        colors=[entity_paths.shade(colour, 0.75)] * 2,
        widths=[1.0, 1.0],
        interpolation_mode="stepafter",
    )
    stream.log(entity_paths.interval_path(name, serial), style, static=True)


def log_truth_style(stream: rr.RecordingStream, name: str, serial: str) -> None:
    """Log the static style of a parameter's true value."""
    style = rr.SeriesLines(names="true", colors=[entity_paths.TRUTH_COLOUR], widths=[1.5])
    stream.log(entity_paths.truth_path(name, serial), style, static=True)


def log_truth(stream: rr.RecordingStream, name: str, serial: str, value: float) -> None:
    """Log a parameter's true value; it is a line from the first estimate to the last."""
    stream.log(entity_paths.truth_path(name, serial), rr.Scalars(value))


def log_network(
    stream: rr.RecordingStream, serial: str, round_trip_ms: float, age_ms: float, refusals: int
) -> None:
    """Log a module's round trip, the age of its newest sample and the number of refused commands."""
    groups = (entity_paths.ROUND_TRIP, entity_paths.AGE, entity_paths.REFUSALS)
    for group, value in zip(groups, (round_trip_ms, age_ms, float(refusals)), strict=True):
        stream.log(entity_paths.network_path(serial, group), rr.Scalars(value))


def send_residuals(
    stream: rr.RecordingStream,
    serial: str,
    t_ns: IntArray,
    measured_nm: NDArray[np.float64],
    predicted_nm: NDArray[np.float64],
) -> None:
    """Log the envelopes of held-out torque (m,), measured and predicted, and of the residual."""
    both = np.stack([measured_nm, predicted_nm], axis=1)
    send_scalars(stream, entity_paths.residual_path(serial, entity_paths.HELD_OUT), *envelope(t_ns, both))
    error = (measured_nm - predicted_nm)[:, None]
    send_scalars(stream, entity_paths.residual_path(serial, entity_paths.ERROR), *envelope(t_ns, error))
