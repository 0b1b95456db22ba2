//! Cameras of any make over real UDP: what their firmware does, and what becomes of frames.

mod bench;
mod firmware;
mod frames;
mod network;
mod real_tables;
