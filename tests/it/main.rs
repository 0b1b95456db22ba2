//! Integration tests of the product: one binary, a module per subject.

mod third_party_camera;
