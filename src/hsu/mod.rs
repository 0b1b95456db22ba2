//! The serial link to the hardware synchronization unit.
