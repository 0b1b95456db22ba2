//! Figures of merit of clouds (paper, section 5).

/// Clouds against rendered ground truth.
pub mod truth;
