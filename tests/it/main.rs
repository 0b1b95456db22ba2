//! Integration tests of the product: one binary, a module per subject.

mod recording;
mod third_party_mcap;
