//! Integration tests of the product: one binary, a module per subject.

mod shared_scene;
