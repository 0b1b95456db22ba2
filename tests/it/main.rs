//! Integration tests of the product: one binary, a module per subject.

mod chain;
mod hsu;
mod lab;
mod recording;
mod third_party_mcap;
mod shared_scene;
