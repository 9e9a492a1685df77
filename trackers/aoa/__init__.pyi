from trackwright.trackers.aoa.beam import Beam as Beam
from trackwright.trackers.aoa.beam import BeamMotion as BeamMotion
from trackwright.trackers.aoa.beam import BeamStart as BeamStart
from trackwright.trackers.aoa.beam import DelayAndSum as DelayAndSum
from trackwright.trackers.aoa.beam import InPlaneBeam as InPlaneBeam
from trackwright.trackers.aoa.beam import InPlaneBeamMotion as InPlaneBeamMotion
from trackwright.trackers.aoa.beam import beam_tracker as beam_tracker
from trackwright.trackers.aoa.beam import in_plane_beam_tracker as in_plane_beam_tracker
from trackwright.trackers.aoa.beamformer import Grid as Grid
from trackwright.trackers.aoa.beamformer import delay_and_sum as delay_and_sum
from trackwright.trackers.aoa.beamformer import strongest as strongest
from trackwright.trackers.aoa.cascade import Cascade as Cascade
from trackwright.trackers.aoa.cascade import cascade_tracker as cascade_tracker
from trackwright.trackers.aoa.direct import PhaseStart as PhaseStart
from trackwright.trackers.aoa.direct import direct_tracker as direct_tracker
from trackwright.trackers.aoa.fusion import BearingSensor as BearingSensor
from trackwright.trackers.aoa.fusion import bearing_inputs as bearing_inputs
from trackwright.trackers.aoa.fusion import bearing_tracker as bearing_tracker
from trackwright.trackers.aoa.phases import InPlanePhases as InPlanePhases
from trackwright.trackers.aoa.phases import PlanePhases as PlanePhases
from trackwright.trackers.aoa.phases import SphericalPhases as SphericalPhases
from trackwright.trackers.aoa.rays import recent_points as recent_points
from trackwright.trackers.aoa.rows import beam_trajectories as beam_trajectories
from trackwright.trackers.aoa.rows import bearing_trajectories as bearing_trajectories
from trackwright.trackers.aoa.rows import phase_trajectories as phase_trajectories
from trackwright.trackers.from_arrays import bearing_recording as bearing_recording
from trackwright.trackers.from_arrays import phase_recording as phase_recording

__all__ = [
    "Beam",
    "BeamMotion",
    "BeamStart",
    "BearingSensor",
    "Cascade",
    "DelayAndSum",
    "Grid",
    "InPlaneBeam",
    "InPlaneBeamMotion",
    "InPlanePhases",
    "PhaseStart",
    "PlanePhases",
    "SphericalPhases",
    "beam_tracker",
    "beam_trajectories",
    "bearing_inputs",
    "bearing_recording",
    "bearing_tracker",
    "bearing_trajectories",
    "cascade_tracker",
    "delay_and_sum",
    "direct_tracker",
    "in_plane_beam_tracker",
    "phase_recording",
    "phase_trajectories",
    "recent_points",
    "strongest",
]
