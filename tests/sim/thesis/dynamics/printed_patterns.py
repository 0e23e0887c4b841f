"""Recordings of the dynamic pattern that came out as the thesis prints them."""

import numpy as np

from module_agent.control.waveform import waveform
from module_agent.wire.messages import Pattern, WindowedSine
from sim.thesis.dynamics.load_identification import IZZ, MCX
from sim.thesis.dynamics.pattern_recording import (
    CheckRun,
    Estimate,
    OurTorques,
    PatternRun,
    PatternSeries,
    Torques,
    dynamic_pattern,
)
from sim.thesis.published import DYNAMIC_MOTION, DYNAMIC_SEARCHES, Alignment

# How strong the torque is [Nm]: the vertical arm's is strongest at 0.2, the horizontal one's grows.
_STRENGTH_NM = {0.9: 1.0, 0.4: 1.2, 0.3: 1.3, 0.1: 1.3, 0.2: 1.6, 0.6: 0.4, 1.4: 0.7, 2.0: 1.0}
# The error relative to the torque.
_RELATIVE = {0.9: 0.3, 0.6: 0.2, 1.4: 0.15}


def as_printed(alignment: Alignment, amplitudes_rad: tuple[float, ...], chosen_rad: float) -> PatternSeries:
    """Return recordings whose errors, torques and parameters are the printed ones."""
    search = DYNAMIC_SEARCHES[alignment]
    phi = np.zeros(10)
    phi[MCX], phi[IZZ] = search.mcx_kg_m, search.izz_kg_m2
    start_nm = 2.0 if alignment == "vertical" else 0.0
    whole = WindowedSine(amplitude=chosen_rad, **DYNAMIC_MOTION._asdict())
    check = _check(_torques(whole, 5.0, start_nm, 1.0))
    truth = phi.copy()
    truth[MCX] = 0.225
    return PatternSeries(
        truth=tuple(truth),
        force_m_s2=(0.0, 9.81, 0.0) if alignment == "vertical" else (0.0, 0.0, 9.81),
        runs=tuple(
            _run(phi, each, start_nm, search.squared_error_nm2.get(each, 5.0)) for each in amplitudes_rad
        ),
        whole=check,
        usual=check,
    )


def _run(phi: np.ndarray, amplitude_rad: float, start_nm: float, squared_error_nm2: float) -> PatternRun:
    torques = _torques(dynamic_pattern(amplitude_rad), 4.0, start_nm, _STRENGTH_NM[amplitude_rad])
    estimate = Estimate(
        phi=tuple(phi),
        squared_error_nm2=squared_error_nm2,
        relative_error=_RELATIVE.get(amplitude_rad, 0.1),
    )
    return PatternRun(
        amplitude_rad=amplitude_rad,
        torques=torques,
        **dict.fromkeys(("thesis", "turning", "unfiltered", "six_rows", "ours"), estimate),
        our_sigma=(0.0,) * 10,
        our_torques=OurTorques(t_s=torques.t_s, calculated_nm=torques.calculated_nm),
    )


def _check(torques: Torques) -> CheckRun:
    own = OurTorques(t_s=torques.t_s, calculated_nm=torques.calculated_nm)
    return CheckRun(torques=torques, relative_error=0.1, our_torques=own, our_relative_error=0.05)


def _torques(pattern: Pattern, duration_s: float, start_nm: float, strength_nm: float) -> Torques:
    t_s = np.arange(round(250 * duration_s)) / 250.0
    motion = waveform(pattern, 0.0, t_s)
    torque = start_nm + strength_nm * motion.velocity_rad_s / np.abs(motion.velocity_rad_s).max()

    def values(signal: np.ndarray) -> tuple[float, ...]:
        return tuple(float(value) for value in signal)

    return Torques(
        t_s=values(t_s),
        position_command_rad=values(motion.offset_rad),
        position_rad=values(motion.offset_rad),
        velocity_command_rad_s=values(motion.velocity_rad_s),
        velocity_rad_s=values(motion.velocity_rad_s),
        acceleration_rad_s2=values(np.gradient(motion.velocity_rad_s, t_s)),
        measured_nm=values(torque),
        calculated_nm=values(0.98 * (torque - start_nm) + start_nm),
    )
