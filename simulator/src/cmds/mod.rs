// SPDX-License-Identifier: MIT OR Apache-2.0
//! One file per command of `fourdbody-sim`.

pub mod bench_ingest;
pub mod cameras;
pub mod check_accounting;
pub mod compare_rig;
pub mod convert_rig;
pub mod export_png;
pub mod gather;
pub mod lab;
pub mod render;
pub mod run;
pub mod summarize;

use crate::sequence::RenderError;
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;

fn failure(error: RenderError) -> Failure {
    let exit = match error {
        RenderError::Config(_) | RenderError::Unfit(_) => Exit::Usage,
        _ => Exit::Failure,
    };
    Failure::new(exit, error)
}
