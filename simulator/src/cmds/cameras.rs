// SPDX-License-Identifier: MIT OR Apache-2.0
//! `fourdbody-sim cameras`: simulated cameras by themselves, for any GigE Vision program.

use crate::gige::make::Table;
use crate::gige::{CameraOptions, ClockOptions, Habits, Make, SimulatedCamera, TestImages, process_cpu_time};
use crate::wire::TriggerEdge;
use crossbeam_channel::{Receiver, never, unbounded};
use fourdbody::base::Exit;
use fourdbody::cmds::Failure;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

/// Run simulated GigE Vision cameras on loopback addresses until interrupted.
///
/// Example: `fourdbody-sim cameras --count 8`, then `arv-tool-0.8` lists them and
/// `arv-camera-test-0.8 -n 127.0.7.11` streams from one.
#[derive(clap::Args)]
pub struct Args {
    /// Number of cameras to simulate.
    #[arg(long, default_value_t = 8)]
    count: u8,
    /// Address of the first camera; the others follow.
    #[arg(long, default_value = "127.0.7.11")]
    first: Ipv4Addr,
    /// Number of columns of the sensor.
    #[arg(long, default_value_t = 1920)]
    width: usize,
    /// Number of rows of the sensor.
    #[arg(long, default_value_t = 1200)]
    height: usize,
    /// Edges per second on all trigger inputs; 0 for none.
    #[arg(long, default_value_t = 0.0)]
    trigger_hz: f64,
    /// Be like the camera of this table: a JSON file of the features that its GenICam description shows. Several are
    /// taken in turn.
    #[arg(long, value_name = "FILE")]
    like: Vec<std::path::PathBuf>,
    /// The entry of TriggerSource that the trigger input is connected to; by default Line0, Line1 or what there is.
    #[arg(long, value_name = "LINE", requires = "like")]
    wired_to: Option<String>,
    /// A feature that the last user left set, until UserSetLoad: GammaEnable=true, TriggerMode[AcquisitionStart]=On.
    #[arg(long, value_name = "FEATURE=VALUE", requires = "like")]
    left_over: Vec<String>,
    /// A feature, or an entry of one, that the table has and these cameras do not: PixelFormat[Mono8].
    #[arg(long, value_name = "FEATURE", requires = "like")]
    without: Vec<String>,
    /// A habit, as a line of a [[habit]] table: 'stamp = "exposure_end"'.
    #[arg(long, value_name = "LINE")]
    habit: Vec<String>,
    /// Lose one packet of this number, to see resend requests at work.
    #[arg(long)]
    lose_one_in: Option<std::num::NonZeroU64>,
    /// Stop after this number of seconds.
    #[arg(long)]
    duration: Option<f64>,
    /// Print the counters of all cameras every second.
    #[arg(long)]
    verbose: bool,
}

pub fn run(args: &Args) -> Result<Exit, Failure> {
    if !(0.0..=10_000.0).contains(&args.trigger_hz) {
        let message = format!("--trigger-hz is {}, expected 0 to 10000", args.trigger_hz);
        return Err(Failure::new(Exit::Usage, message));
    }
    let makes = makes(args).map_err(|message| Failure::new(Exit::Usage, message))?;
    let mut cameras = Vec::new();
    let mut wires = Vec::new();
    for index in 0..args.count {
        let (wire, triggers) = unbounded();
        cameras.push(start(args, index, &makes, if args.trigger_hz > 0.0 { triggers } else { never() })?);
        wires.push(wire);
    }
    for camera in &cameras {
        println!("{}", camera.address());
    }
    let started = Instant::now();
    let mut index = 0u64;
    let mut next_report = started + Duration::from_secs(1);
    loop {
        let next = match args.trigger_hz {
            0.0 => next_report,
            hz => started + Duration::from_secs_f64(index as f64 / hz),
        };
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
        if args.trigger_hz > 0.0 {
            // A timer in hardware does not wait for this thread to wake up: the edge rises on schedule.
            let edge = TriggerEdge { instant: index as i64, time: next, width_ns: 1_000_000 };
            for wire in &wires {
                let _ = wire.send(edge);
            }
            index += 1;
        }
        if Instant::now() >= next_report {
            next_report += Duration::from_secs(1);
            if args.verbose {
                report(&cameras, started.elapsed());
            }
        }
        if args.duration.is_some_and(|seconds| started.elapsed().as_secs_f64() >= seconds) {
            report(&cameras, started.elapsed());
            return Ok(Exit::Done);
        }
    }
}

/// What the cameras are like.
fn makes(args: &Args) -> Result<Vec<Arc<Make>>, String> {
    args.like.iter().map(|path| make(args, path).map(Arc::new)).collect()
}

fn make(args: &Args, path: &std::path::Path) -> Result<Make, String> {
    let mut table = Table::load(path).map_err(|e| e.to_string())?;
    for name in &args.without {
        table = table.without(name).map_err(|e| e.to_string())?;
    }
    let mut make = Make::new(table).map_err(|e| e.to_string())?;
    if let Some(line) = &args.wired_to {
        make = make.wired_to(line).map_err(|e| e.to_string())?;
    }
    for left_over in &args.left_over {
        let (name, value) = left_over
            .split_once('=')
            .ok_or_else(|| format!("--left-over {left_over}: expected FEATURE=VALUE"))?;
        make = make.left_over(name, value).map_err(|e| e.to_string())?;
    }
    Ok(make)
}

fn habits(args: &Args) -> Result<Habits, Failure> {
    // These are read by other programs from a file, and are not used here.
    let own = |line: &&String| {
        let key = line.split('=').next().unwrap_or("").trim();
        ["like", "wired_to", "left_over", "without"].contains(&key)
    };
    if let Some(line) = args.habit.iter().find(own) {
        let message =
            format!("--habit '{line}': expected --like, --wired-to, --left-over or --without for that");
        return Err(Failure::new(Exit::Usage, message));
    }
    let text = format!("[[habit]]\ncamera = \"\"\n{}", args.habit.join("\n"));
    let habits = Habits::parse(&text).map_err(|e| Failure::new(Exit::Usage, e))?;
    Ok(habits.into_values().next().unwrap_or_default())
}

fn start(
    args: &Args,
    index: u8,
    makes: &[Arc<Make>],
    triggers: Receiver<TriggerEdge>,
) -> Result<SimulatedCamera, Failure> {
    let address = args.first.to_bits().checked_add(u32::from(index)).map(Ipv4Addr::from_bits);
    let address = address.ok_or_else(|| Failure::new(Exit::Usage, "the addresses run out of the range"))?;
    let images = TestImages::new(args.width, args.height, u32::from(index), TestImages::DISTINCT);
    let mut options = CameraOptions::new(&format!("SIM{index:04}"), address, Arc::new(images));
    options.user_name = format!("camera{index}");
    options.triggers = triggers;
    options.habits = habits(args)?;
    options.make = makes.iter().cycle().nth(usize::from(index)).cloned();
    // Every clock of its own, as in the laboratory.
    options.clock = ClockOptions {
        offset_ns: 1_000_000_000 * (1 + u64::from(index)),
        drift_ppm: f64::from(index) * 10.0 - 35.0,
    };
    if let Some(one_in) = args.lose_one_in {
        options.lose = Some(Arc::new(move |block, packet| {
            // A hash instead of chance: the same packets are lost every time.
            let mut mixed = (block << 20).wrapping_add(u64::from(packet)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            mixed = (mixed ^ mixed >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93);
            (mixed >> 32).is_multiple_of(one_in.get())
        }));
    }
    SimulatedCamera::start(options).map_err(|error| Failure::new(Exit::Failure, error))
}

fn report(cameras: &[SimulatedCamera], elapsed: Duration) {
    let cpu = process_cpu_time().as_secs_f64();
    println!("{:.1} s, {cpu:.2} s of CPU", elapsed.as_secs_f64());
    for camera in cameras {
        let s = camera.statistics();
        println!(
            "  {} frames {} packets {} resent {} unavailable {} ignored {} unheard {} errors {} lag {:.1} ms",
            camera.address(),
            s.frames_sent.load(Relaxed),
            s.packets_sent.load(Relaxed),
            s.packets_resent.load(Relaxed),
            s.resends_unavailable.load(Relaxed),
            s.triggers_ignored.load(Relaxed),
            s.edges_unheard.load(Relaxed),
            s.send_errors.load(Relaxed),
            s.worst_lag_ns.load(Relaxed) as f64 / 1e6,
        );
    }
}
