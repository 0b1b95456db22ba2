//! Integration tests of the product: one binary, a module per subject.

mod hsu;
mod recording;
mod third_party_mcap;
