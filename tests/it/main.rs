//! Integration tests of the product: one binary, a module per subject.

mod analytic_scene;
mod shared_scene;
