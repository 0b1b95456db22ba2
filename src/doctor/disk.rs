// SPDX-License-Identifier: MIT OR Apache-2.0
//! The disk of the recordings: can it take what the cameras give, and for how long?

use super::finding::{Check, Finding, Grade, bytes};
use super::load::Load;
use crate::base::Scratch;
use crate::base::ids::{BlockId, SessionName, TriggerIndex};
use crate::base::time::host_time_ns;
use crate::config::NodeConfig;
use crate::host::frame_memory::Block;
use crate::record::envelope::pixels_crc;
use crate::record::{
    CameraHeader, FrameMeta, GapCause, Recording, RecordingHeader, SessionEnd, WriterOptions, free_bytes,
};
use crossbeam_channel::{Receiver, Sender, bounded};
use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How many times faster than the cameras the disk must be: no disk is always as fast as in a short test.
const SPEED_FACTOR: f64 = 1.3;
/// Number of noise frames in memory during the test, of all cameras together.
const POOL_FRAMES: usize = 32;
/// Name of the file on which flags are tried; the process's id follows.
const PROBE: &str = ".fourdbody-doctor-probe-";
/// Name of the directory of the test recording; the process's id follows.
const SCRATCH: &str = ".fourdbody-doctor-recording-";
/// A disk that writes no frame within this time is broken.
const PATIENCE: Duration = Duration::from_secs(60);
/// Minutes of a long session; a disk with room for less gets a warning.
const USUAL_MINUTES: f64 = 10.0;

/// The measurements of the test recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Speed {
    /// Bytes of pixels that were written.
    pub bytes: u64,
    /// From the first frame until everything was on the medium.
    pub elapsed: Duration,
    /// The longest time that a frame had to wait to be taken.
    pub longest_wait: Duration,
}

/// Facts about the disk of the recordings.
#[derive(Debug)]
pub struct DiskFacts {
    /// The directory of the recordings, as configured.
    pub sessions_dir: PathBuf,
    /// The directory itself, or the nearest one above it that exists.
    pub examined: PathBuf,
    /// Whether the file system supports `O_DIRECT`; the system's error message if not, or if no file can be made.
    pub direct: Result<(), String>,
    /// Whether space can be reserved (`fallocate`); the system's error message if not.
    pub fallocate: Result<(), String>,
    /// Whether the file system discards the blocks of every removed file at once (mount option `discard`).
    pub discards: bool,
    /// Free bytes in `examined`, or the system's error message.
    pub free: Result<u64, String>,
    /// Bytes that the node keeps free.
    pub reserve: u64,
    /// The test recording, or why it failed; `None` when there was none.
    pub speed: Option<Result<Speed, String>>,
}

impl DiskFacts {
    /// Reads all facts, and records noise for `test` (zero: not at all). Everything written is deleted.
    /// `progress` receives the elapsed and the whole duration of the test.
    pub fn gather(config: &NodeConfig, test: Duration, progress: &dyn Fn(Duration, Duration)) -> Self {
        let sessions_dir = std::path::absolute(&config.sessions_dir).unwrap_or(config.sessions_dir.clone());
        let examined = sessions_dir.ancestors().find(|dir| dir.is_dir()).unwrap_or(Path::new("/")).to_owned();
        remove_leftovers(&examined);
        let free = free_bytes(&examined).map_err(|e| e.to_string());
        let speed = (!test.is_zero()).then(|| record_noise(config, &examined, test, progress));
        Self {
            direct: probe(&examined, libc::O_DIRECT, |_| Ok(())).map_err(|e| e.to_string()),
            fallocate: probe(&examined, 0, reserve_space).map_err(|e| e.to_string()),
            discards: std::fs::read_to_string("/proc/self/mounts")
                .is_ok_and(|mounts| has_mount_option(&mounts, &examined, "discard")),
            sessions_dir,
            examined,
            free,
            reserve: config.reserve_bytes,
            speed,
        }
    }
}

/// Whether the file system that a directory lies on is mounted with an option; `mounts` as proc(5) has it.
fn has_mount_option(mounts: &str, dir: &Path, option: &str) -> bool {
    let dir = dir.canonicalize().unwrap_or(dir.to_owned());
    let lines = mounts.lines().filter_map(|line| {
        let mut fields = line.split(' ').skip(1);
        // Spaces in names are written as octal numbers.
        let point = PathBuf::from(fields.next()?.replace("\\040", " "));
        Some((point, fields.nth(1)?))
    });
    let around = lines.filter(|(point, _)| dir.starts_with(point));
    // Of two mounts at one point the later one is seen.
    let nearest = around.max_by_key(|(point, _)| point.components().count());
    nearest.is_some_and(|(_, options)| options.split(',').any(|found| found == option))
}

/// Tries something on a new file, which is removed again.
fn probe(dir: &Path, flags: i32, attempt: impl FnOnce(&File) -> io::Result<()>) -> io::Result<()> {
    let path = dir.join(format!("{PROBE}{}", std::process::id()));
    let opened = OpenOptions::new().write(true).create_new(true).custom_flags(flags).open(&path);
    let result = opened.and_then(|file| attempt(&file));
    // Some file systems create the file before they refuse a flag.
    let _ = std::fs::remove_file(&path);
    result
}

fn reserve_space(file: &File) -> io::Result<()> {
    // SAFETY: the descriptor is open for the duration of the call.
    match unsafe { libc::fallocate(file.as_raw_fd(), libc::FALLOC_FL_KEEP_SIZE, 0, 1 << 20) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Removes test recordings of processes that were killed: they may fill the disk.
fn remove_leftovers(dir: &Path) {
    let Ok(entries) = std::fs::read_dir(dir) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        let id = name.strip_prefix(SCRATCH).and_then(|id| id.parse::<u32>().ok());
        if id.is_some_and(|id| !Path::new(&format!("/proc/{id}")).exists()) {
            // What cannot be removed shows in the free space.
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

/// A recording of noise by the product's own writer, as fast as it goes.
fn record_noise(
    config: &NodeConfig,
    dir: &Path,
    test: Duration,
    progress: &dyn Fn(Duration, Duration),
) -> Result<Speed, String> {
    let header = noise_header(config);
    let sizes: Vec<(u32, u32)> = header.cameras.iter().map(|c| (c.width, c.height)).collect();
    if sizes.is_empty() {
        return Err("the node has no cameras".to_owned());
    }
    let free = free_bytes(dir).map_err(|e| e.to_string())?;
    // Half of what is not reserved: the test must not be what fills the disk.
    let limit = free.saturating_sub(config.reserve_bytes) / 2;
    let options = WriterOptions {
        segment_bytes: config.segment_bytes,
        reserve_bytes: config.reserve_bytes,
        ..WriterOptions::default()
    };
    let scratch = Scratch(dir.join(format!("{SCRATCH}{}", std::process::id())));
    let mut recording = Recording::create(&scratch.0, header, options).map_err(|e| e.to_string())?;
    let pools = noise_pools(&sizes);
    let mut speed = Speed { bytes: 0, elapsed: Duration::ZERO, longest_wait: Duration::ZERO };
    let begun = Instant::now();
    let mut trigger = 0;
    while begun.elapsed() < test && speed.bytes < limit {
        for (camera, (&(width, height), pool)) in sizes.iter().zip(&pools).enumerate() {
            let begun_waiting = Instant::now();
            let block = pool.lend().ok_or("the disk took nothing for a minute")?;
            let meta = FrameMeta {
                trigger: TriggerIndex(trigger),
                block: BlockId(trigger + 1),
                camera_time_ns: trigger,
                host_time_ns: host_time_ns(),
                width,
                height,
                pixels_crc: pool.checksum,
            };
            recording.frame_in_place(camera, &meta, block).map_err(|e| e.to_string())?;
            speed.longest_wait = speed.longest_wait.max(begun_waiting.elapsed());
            speed.bytes += u64::from(width) * u64::from(height);
        }
        trigger += 1;
        progress(begun.elapsed(), test);
    }
    let end = SessionEnd {
        triggers_emitted: Some(trigger),
        aborted: None,
        absent: GapCause::Unknown,
        host_time_ns: host_time_ns(),
    };
    recording.finish(end).map_err(|e| e.to_string())?;
    speed.elapsed = begun.elapsed();
    Ok(speed)
}

/// One camera's noise frames, in blocks that return when the writer has written them.
struct Pool {
    checksum: u32,
    home: Sender<Block>,
    returns: Receiver<Block>,
}

impl Pool {
    fn new(pixels: usize, blocks: usize) -> Self {
        let (home, returns) = bounded(blocks);
        let mut checksum = 0;
        for _ in 0..blocks {
            let mut block = Block::allocate(pixels);
            let room = block.bytes().len() - pixels;
            let noise = (0u32..).map(|n| (n.wrapping_mul(0x9e37_79b9) >> 24) as u8);
            block.bytes_mut()[room..].iter_mut().zip(noise).for_each(|(pixel, value)| *pixel = value);
            checksum = pixels_crc(block.pixels());
            // There is room for all of them.
            let _ = home.send(block);
        }
        Self { checksum, home, returns }
    }

    fn lend(&self) -> Option<Block> {
        let mut block = self.returns.recv_timeout(PATIENCE).ok()?;
        block.set_home(self.home.clone());
        Some(block)
    }
}

fn noise_pools(sizes: &[(u32, u32)]) -> Vec<Pool> {
    let blocks = (POOL_FRAMES / sizes.len()).max(2);
    sizes.iter().map(|&(width, height)| Pool::new(width as usize * height as usize, blocks)).collect()
}

fn noise_header(config: &NodeConfig) -> RecordingHeader {
    let cameras = config.rig.cameras_of(&config.node).map(|(_, camera)| CameraHeader {
        id: camera.id.clone(),
        width: camera.device.width as u32,
        height: camera.device.height as u32,
        device: String::new(),
        pixel_format: String::new(),
        settings: Vec::new(),
        state: std::collections::BTreeMap::new(),
    });
    RecordingHeader {
        session: SessionName::from("doctor"),
        session_id: "doctor".to_owned(),
        node: config.node.clone(),
        rig_text: config.rig_text.clone(),
        cameras: cameras.collect(),
        hsu: None,
        expected_triggers: None,
        trigger_rate_hz: config.rig.trigger_rate_hz,
        host_clock: "CLOCK_REALTIME".to_owned(),
        created_ns: host_time_ns(),
        software: format!("fourdbody {} doctor", env!("CARGO_PKG_VERSION")),
        subject: None,
        note: None,
    }
}

/// The verdicts on the disk.
pub fn judge(facts: &DiskFacts, load: &Load) -> Vec<Finding> {
    let mut findings = vec![judge_directory(facts)];
    if findings[0].grade == Grade::Failed {
        return findings;
    }
    for (name, what, result, expected) in [
        (
            "direct writes",
            "O_DIRECT",
            &facts.direct,
            "direct writes: through the page cache they stall for seconds",
        ),
        (
            "reserved space",
            "fallocate",
            &facts.fallocate,
            "segments whose space is reserved before they are written",
        ),
    ] {
        findings.push(match result {
            Ok(()) => Check::host(name).ok(format!("the file system supports {what}")),
            Err(error) => Check::host(name).warning(
                format!("the file system refuses {what} ({error})"),
                expected,
                "use ext4 or XFS on a local disk",
            ),
        });
    }
    let check = Check::host("discard");
    findings.push(match facts.discards {
        false => check.ok("removed files are not discarded at once"),
        true => check.warning(
            "the file system is mounted with `discard`".to_owned(),
            "a disk that does not stop for every session that is deleted (0.4 s for 2 GiB were measured)",
            "mount it without, and enable fstrim.timer",
        ),
    });
    findings.push(judge_space(facts, load));
    findings.extend(judge_speed(facts, load));
    findings
}

fn judge_directory(facts: &DiskFacts) -> Finding {
    let check = Check::host("sessions directory");
    let dir = facts.sessions_dir.display();
    // If neither kind of file can be made, the directory is not writable.
    match (&facts.direct, &facts.fallocate) {
        (Err(error), Err(_)) => check.failed(
            format!("no file can be made in {} ({error})", facts.examined.display()),
            format!("to write in {dir} (storage.sessions_dir)"),
            "create it and give it to the node's user, or correct the path",
        ),
        _ if facts.examined != facts.sessions_dir => {
            check.ok(format!("{dir} does not exist; the first session makes it"))
        }
        _ => check.ok(format!("{dir}")),
    }
}

fn judge_space(facts: &DiskFacts, load: &Load) -> Finding {
    let check = Check::host("disk space");
    let free = match &facts.free {
        Ok(free) => *free,
        Err(error) => {
            return check.failed(format!("cannot be read ({error})"), "free space", "check the disk");
        }
    };
    let usable = free.saturating_sub(facts.reserve);
    let minutes = usable as f64 / load.bytes_per_s().max(1.0) / 60.0;
    let found = format!("{} beyond the reserve of {}: {minutes:.1} min", bytes(usable), bytes(facts.reserve));
    let (grade, expected) = match usable {
        0 => (Grade::Failed, format!("more free space than {}", bytes(facts.reserve))),
        _ if minutes < USUAL_MINUTES => (Grade::Warning, format!("{USUAL_MINUTES:.0} min")),
        _ => (Grade::Ok, String::new()),
    };
    check.graded(grade, found, expected, "delete or move sessions")
}

fn judge_speed(facts: &DiskFacts, load: &Load) -> Vec<Finding> {
    let check = Check::host("disk speed");
    let megabytes = |per_s: f64| format!("{:.0} MB/s", per_s / 1e6);
    let needed = load.bytes_per_s() * SPEED_FACTOR;
    let of_cameras = megabytes(load.bytes_per_s());
    let expected = format!("{}: {SPEED_FACTOR} x the {of_cameras} of the cameras", megabytes(needed));
    let speed = match &facts.speed {
        None => {
            let advice = "run with --disk-seconds 3 while no node runs here";
            return vec![check.warning("not measured", expected, advice)];
        }
        Some(Err(error)) => {
            let found = format!("the test recording failed: {error}");
            return vec![check.failed(found, expected, "check the disk")];
        }
        Some(Ok(speed)) => speed,
    };
    let rate = speed.bytes as f64 / speed.elapsed.as_secs_f64().max(1e-9);
    let grade = match rate {
        rate if rate >= needed => Grade::Ok,
        rate if rate >= load.bytes_per_s() => Grade::Warning,
        _ => Grade::Failed,
    };
    let found = format!("{} over {:.1} s", megabytes(rate), speed.elapsed.as_secs_f64());
    let advice = "free the disk of other work, or use a faster one (NVMe)";
    let first = check.graded(grade, found, expected, advice);
    let (wait, held) = (speed.longest_wait.as_secs_f64(), load.buffered_s());
    // The test writes as fast as it can; a pause that fills half the frame buffers leaves too little room.
    let second = Check::host("disk pauses").graded(
        if wait <= held / 2.0 { Grade::Ok } else { Grade::Warning },
        format!("{:.0} ms at the longest", wait * 1e3),
        format!("at most half of the {:.0} ms that the frame buffers hold", held * 1e3),
        "raise acquisition.buffers_per_camera, or use a faster disk",
    );
    vec![first, second]
}

#[cfg(test)]
mod tests {
    use super::{DiskFacts, SCRATCH, Speed, has_mount_option, judge, remove_leftovers};
    use crate::doctor::finding::Grade;
    use crate::doctor::load::Load;
    use std::path::Path;
    use std::time::Duration;

    fn good() -> DiskFacts {
        DiskFacts {
            sessions_dir: "/data/sessions".into(),
            examined: "/data/sessions".into(),
            direct: Ok(()),
            fallocate: Ok(()),
            discards: false,
            free: Ok(2 << 40),
            reserve: 4 << 30,
            speed: Some(Ok(Speed {
                bytes: 6_000_000_000,
                elapsed: Duration::from_secs(3),
                longest_wait: Duration::from_millis(20),
            })),
        }
    }

    fn complaints(facts: &DiskFacts) -> Vec<(String, Grade)> {
        let findings = judge(facts, &Load::reference()).into_iter().filter(|f| f.grade != Grade::Ok);
        findings.map(|f| (f.check, f.grade)).collect()
    }

    #[test]
    fn a_disk_is_judged_by_the_cameras_rate_with_a_margin() {
        assert_eq!(complaints(&good()), []);
        let at = |megabytes: u64| {
            let bytes = 3_000_000 * megabytes;
            let speed = Speed { bytes, elapsed: Duration::from_secs(3), longest_wait: Duration::ZERO };
            complaints(&DiskFacts { speed: Some(Ok(speed)), ..good() })
        };
        let slow = |grade| vec![("disk speed".to_owned(), grade)];
        // 1106 MB/s, and 1438 with the margin.
        assert_eq!([at(1100), at(1110), at(1430)], [Grade::Failed, Grade::Warning, Grade::Warning].map(slow));
        assert_eq!(at(1440), []);
    }

    #[test]
    fn the_nearest_mount_counts() {
        let mounts = "/dev/a / ext4 rw,discard 0 0\n/dev/b /data ext4 rw,nodiscard 0 0\n/dev/c /data/old\\040ones \
            xfs discard,rw 0 0\n";
        let discards = |dir: &str| has_mount_option(mounts, Path::new(dir), "discard");
        assert_eq!(["/", "/database", "/data/sessions"].map(discards), [true, true, false]);
        assert!(discards("/data/old ones/sessions"));
        assert!(!has_mount_option("not a mount", Path::new("/"), "discard"));
    }

    #[test]
    fn leftovers_of_killed_processes_are_removed_and_nothing_else() {
        let dir = tempfile::tempdir().expect("a temporary directory");
        let make = |name: String| {
            std::fs::create_dir(dir.path().join(&name)).expect("a directory");
            dir.path().join(name)
        };
        // Process ids end at 2^22.
        let dead = make(format!("{SCRATCH}4194305"));
        std::fs::write(dead.join("segment-000.mcap"), b"noise").expect("a file");
        let others = [
            make(format!("{SCRATCH}{}", std::process::id())),
            make("walk-01".to_owned()),
            make(format!("{SCRATCH}x")),
        ];
        remove_leftovers(dir.path());
        assert!(!dead.exists() && others.iter().all(|path| path.exists()));
    }

    #[test]
    fn pauses_space_and_refusals_are_reported() {
        let pause = Speed {
            bytes: 6_000_000_000,
            elapsed: Duration::from_secs(3),
            longest_wait: Duration::from_millis(400),
        };
        let facts = DiskFacts { speed: Some(Ok(pause)), ..good() };
        assert_eq!(complaints(&facts), [("disk pauses".to_owned(), Grade::Warning)]);
        let refusal = || Err("Invalid argument".to_owned());
        let facts = DiskFacts { direct: refusal(), free: Ok(64 << 30), speed: None, ..good() };
        let names = ["direct writes", "disk space", "disk speed"];
        assert_eq!(complaints(&facts), names.map(|name| (name.to_owned(), Grade::Warning)));
        let facts = DiskFacts { discards: true, ..good() };
        assert_eq!(complaints(&facts), [("discard".to_owned(), Grade::Warning)]);
        let facts = DiskFacts { free: Ok(1 << 30), ..good() };
        assert_eq!(complaints(&facts), [("disk space".to_owned(), Grade::Failed)]);
        let facts = DiskFacts { direct: refusal(), fallocate: refusal(), ..good() };
        assert_eq!(complaints(&facts), [("sessions directory".to_owned(), Grade::Failed)]);
    }
}
