// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the node is compared with: Aravis that only receives, and a disk that is only written to.

use super::process::{Program, Reading, Usage, failed, load_average};
use super::train::{program, remove};
use super::{Args, CAMERAS, FRAME_BYTES, insert};
use fourdbody::cmds::Failure;
use serde_json::{Map, Value};
use std::io::{BufRead, BufReader};
use std::process::Command;
use std::time::Duration;

/// Four `arv-camera-test-0.8`, which receive and throw away: frames a second of all together, cores, failures.
pub fn receive_only(
    args: &Args,
    rate_hz: f64,
    seconds: f64,
    summary: &mut Map<String, Value>,
) -> Result<(), Failure> {
    const SETTLING: Duration = Duration::from_secs(2);
    let load = load_average();
    let mut command = Command::new(program(args, "fourdbody-sim"));
    command.args(["cameras", "--first", "127.0.9.21", "--count"]).arg(CAMERAS.to_string());
    command.arg("--trigger-hz").arg(rate_hz.to_string());
    let mut simulator = Program::start("receive_simulator", &mut command, &args.out)?;
    let mut lines = BufReader::new(simulator.output()?).lines();
    let addresses: Vec<String> = lines.by_ref().take(CAMERAS).collect::<Result<_, _>>().map_err(failed)?;
    // All streams are created in the pause that the first one's settling leaves.
    let duration = (seconds + 2.0 * SETTLING.as_secs_f64()).ceil().to_string();
    let receive = |address: &String| {
        let mut command = Command::new("arv-camera-test-0.8");
        command.args(["-n", address, "-t", "Line0", "-j", "never", "-m", "200", "-i"]);
        command.arg(args.packet_bytes.to_string()).args(["--duration", &duration]);
        Program::start("receive", &mut command, &args.out)
    };
    let receivers: Vec<Program> = addresses.iter().map(receive).collect::<Result<_, _>>()?;
    std::thread::sleep(SETTLING);
    let programs: Vec<&Program> = std::iter::once(&simulator).chain(&receivers).collect();
    let before = Reading::of(&programs);
    std::thread::sleep(Duration::from_secs_f64(seconds));
    let cores = before.until(&Reading::of(&programs));
    drop(programs);
    let (mut rate, mut failures, mut missing) = (0.0, 0.0, 0.0);
    for receiver in receivers {
        let (text, _) = receiver.finish()?;
        rate += mean_rate(&text);
        failures += counter(&text, "n_failures") + counter(&text, "n_underruns");
        missing += counter(&text, "n_missing_packets");
    }
    let (sender, receivers) = cores.programs.split_first().ok_or_else(|| failed("nothing was measured"))?;
    insert(summary, "receive_only_frames_per_s", rate);
    insert(summary, "receive_only_failures_and_underruns", failures);
    insert(summary, "receive_only_missing_packets", missing);
    insert(summary, "receive_only_cpu_cores", receivers.iter().copied().sum::<Usage>().total_s());
    insert(summary, "receive_only_simulator_cpu_cores", sender.total_s());
    insert(summary, "receive_only_other_cpu_cores", cores.others);
    insert(summary, "receive_only_load_average", load);
    Ok(())
}

/// Mean of the lines `120 frames/s - 276 MiB/s`, without the first and the last two, in which streams begin and end.
fn mean_rate(text: &str) -> f64 {
    let rates: Vec<f64> =
        text.lines().filter_map(|line| line.split_once(" frames/s")?.0.trim().parse().ok()).collect();
    let middle = rates.get(2..rates.len().saturating_sub(2)).unwrap_or(&[]);
    middle.iter().sum::<f64>() / middle.len().max(1) as f64
}

/// One of the counters that follow, `n_failures             = 0`.
fn counter(text: &str, name: &str) -> f64 {
    let line = text.lines().find(|line| line.split_whitespace().next() == Some(name));
    line.and_then(|line| line.split('=').nth(1)?.trim().parse().ok()).unwrap_or(0.0)
}

/// `fio`: the bytes of `frames` frames, sequential direct writes of 4 MiB, four under way.
pub fn disk_only(args: &Args, frames: u64, summary: &mut Map<String, Value>) -> Result<(), Failure> {
    let load = load_average();
    let file = args.out.join("fio.bytes");
    let mut command = Command::new("fio");
    command.args([
        "--name=ingest",
        "--rw=write",
        "--bs=4M",
        "--direct=1",
        "--ioengine=io_uring",
        "--iodepth=4",
    ]);
    command.args(["--end_fsync=1", "--output-format=json"]).arg(format!("--filename={}", file.display()));
    command.arg(format!("--size={}", (frames as f64 * FRAME_BYTES) as u64));
    let (text, status) = Program::start("fio", &mut command, &args.out)?.finish()?;
    remove(&file)?;
    // Warnings may stand before the report.
    let report = text.find('{').and_then(|start| serde_json::from_str::<Value>(&text[start..]).ok());
    let report =
        report.ok_or_else(|| failed(format!("fio failed ({status}); see {}/fio.log", args.out.display())))?;
    let write = &report["jobs"][0]["write"];
    insert(summary, "fio_direct_write_mb_s", write["bw_bytes"].as_f64().unwrap_or(0.0) / 1e6);
    insert(
        summary,
        "fio_direct_write_p99_ms",
        write["clat_ns"]["percentile"]["99.000000"].as_f64().unwrap_or(0.0) / 1e6,
    );
    insert(summary, "fio_load_average", load);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_output_of_the_camera_test_is_understood() {
        let text = "gv packet size         = 9000 bytes\n 40 frames/s -     92 MiB/s\n119 frames/s -     274 MiB/s\n\
                    120 frames/s -     276 MiB/s\n118 frames/s -     276 MiB/s\n 121 frames/s -     276 MiB/s\n\
                    60 frames/s -     1 MiB/s\nn_completed_buffers    = 960\nn_failures             = 3\n";
        assert_eq!(mean_rate(text), 119.0);
        assert_eq!((counter(text, "n_failures"), counter(text, "n_underruns")), (3.0, 0.0));
        assert_eq!(mean_rate(""), 0.0);
    }
}
