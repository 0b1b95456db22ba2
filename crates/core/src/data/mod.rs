// SPDX-License-Identifier: MIT OR Apache-2.0
//! What flows between the parts of the program: frames of a session, phase maps, clouds, and the calibration.

mod calibration;
mod cloud;
mod frame_source;
mod phase_map;

pub use calibration::{
    CONVENTIONS, CalibratedCamera, CalibratedHead, Calibration, CameraResiduals, DeviceUncertainty, Extent,
    HeadLink, HeadVolume, Identity, PanelRows, Quality, Response, ValidVolume, World,
};
pub use cloud::{Cloud, NO_CAMERA};
pub use frame_source::{Frame, FrameSource, LostPart, SessionIdentity, SourceStatement, StatedCamera};
pub use phase_map::{PhaseMap, Run, STEPS_PER_FRINGE, STEPS_PER_LEVEL, decode_sigma, encode_sigma};
