//! Integration tests of the product: one binary, a module per subject.

mod recording;
mod recording_commands;
mod recording_damage;
mod third_party_mcap;
