// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files of some kilobytes that were made to cost: `verify`, `info` and `recover` read them in memory and in time that the file
//! itself bounds, and never say that they are good.
//!
//! Each command runs in a process of its own, which may have so much memory and no more. Time is only compared: that of a file eight
//! times as large is not that of one with eight times eight as many pairs.

use crate::lab::FOURDBODY;
use crate::recording::{frame, header, options, quick_dir, trigger};
use crate::recording_damage::{as_recording, one_segment};
use fourdbody::base::ids::CameraId;
use fourdbody::record::{ClockSample, Recording, WarmUp};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};

const MESSAGE: u8 = 5;
const CHUNK: u8 = 6;
const METADATA: u8 = 12;
const METADATA_INDEX: u8 = 13;
const DATA_END: u8 = 15;
const FOOTER: u8 = 2;
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// What a process may write to, bytes: a hundred times what the files are.
const MEMORY: u64 = 512 << 20;

/// Runs a command without more memory than [`MEMORY`]; returns its exit code, and the processor time that it took, seconds.
fn cost(args: &[&str]) -> (Option<i32>, f64) {
    let mut command = Command::new(FOURDBODY);
    command.args(args).stdout(Stdio::null()).stderr(Stdio::null()).env("RAYON_NUM_THREADS", "2");
    // SAFETY: only system calls, between fork and exec.
    unsafe {
        command.pre_exec(|| {
            // A command that would never end is ended: nothing else is judged by it.
            for (what, most) in [(libc::RLIMIT_DATA, MEMORY), (libc::RLIMIT_CPU, 300)] {
                let limit = libc::rlimit { rlim_cur: most, rlim_max: most };
                if libc::setrlimit(what, &raw const limit) != 0 {
                    return Err(std::io::Error::last_os_error());
                }
            }
            Ok(())
        });
    }
    // `wait4` below is its `wait`, and tells the time as well.
    #[expect(clippy::zombie_processes)]
    let child = command.spawn().expect("it starts");
    let mut status = 0;
    let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: our own child, which nobody else waits for, and valid places for what is told of it.
    let usage = unsafe {
        assert_eq!(libc::wait4(child.id() as i32, &raw mut status, 0, usage.as_mut_ptr()), child.id() as i32);
        usage.assume_init()
    };
    let seconds = |time: libc::timeval| time.tv_sec as f64 + time.tv_usec as f64 / 1e6;
    let code = libc::WIFEXITED(status).then(|| libc::WEXITSTATUS(status));
    (code, seconds(usage.ru_utime) + seconds(usage.ru_stime))
}

/// What is made of a file: `info` describes it, `verify` never calls it good, `recover` saves it with loss or not at all. Returns
/// what the three cost together.
fn cost_of_all(what: &str, path: &Path, info: i32) -> f64 {
    let (shown, out) = (path.to_str().expect("UTF-8"), path.with_file_name("recovered"));
    let _ = std::fs::remove_dir_all(&out);
    let (code, of_info) = cost(&["info", shown]);
    assert_eq!(code, Some(info), "info: {what}");
    let (code, of_verify) = cost(&["verify", shown]);
    assert_eq!(code, Some(4), "verify: {what}");
    let (code, of_recover) = cost(&["recover", shown, "--out", out.to_str().expect("UTF-8")]);
    assert!(matches!(code, Some(0 | 3 | 4)), "recover: {what}: {code:?}");
    of_info + of_verify + of_recover
}

/// That eight times as much costs about eight times as much: sixteen at most, where pairs would cost 64. What a process costs before
/// it has read anything is known from a small file.
fn assert_bounded(what: &str, make: impl Fn(&Path, usize) -> std::path::PathBuf, size: usize) {
    let dir = quick_dir();
    let costs = [1, size, 8 * size].map(|size| {
        let path = make(&dir.path().join(size.to_string()), size);
        cost_of_all(&format!("{what}, {size}"), &path, 0)
    });
    let [start, small, large] = costs;
    let (small, large) = (small.max(start), large - start);
    assert!(large < 16.0 * small, "{what}: {start:.3} s, {small:.3} s, eight times as much {large:.3} s");
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(text: &[u8]) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text].concat()
}

fn metadata(name: &str, entries: &[(&str, &str)]) -> Vec<u8> {
    let entries: Vec<u8> = entries
        .iter()
        .flat_map(|(key, value)| [text(key.as_bytes()), text(value.as_bytes())].concat())
        .collect();
    record(METADATA, &[text(name.as_bytes()), text(&entries)].concat())
}

/// A good recording up to the end of its data, without it; and the mark of its session.
fn open_end() -> (Vec<u8>, String) {
    let mut bytes = one_segment(3);
    let mark = bytes.windows(12).position(|window| window == b"session_mark").expect("a mark");
    let mark = String::from_utf8(bytes[mark + 16..mark + 32].to_vec()).expect("text");
    let (mut at, mut end) = (MAGIC.len(), 0);
    while bytes[at] != DATA_END {
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("8 bytes")) as usize;
        end = at;
    }
    bytes.truncate(end);
    (bytes, mark)
}

/// Closes a file with this summary.
fn closed(mut bytes: Vec<u8>, summary: &[u8]) -> Vec<u8> {
    bytes.extend(record(DATA_END, &[0; 4]));
    let start = bytes.len() as u64;
    let footer = record(FOOTER, &[&start.to_le_bytes()[..], &[0; 12]].concat());
    bytes.extend([summary, &footer, MAGIC].concat());
    bytes
}

/// Every entry of the summary leads to one long record.
#[test]
fn entries_of_a_summary_may_all_lead_to_one_record() {
    let make = |dir: &Path, size: usize| {
        let (mut bytes, _) = open_end();
        let at = bytes.len() as u64;
        let long = metadata("another", &[("key", &"x".repeat(256 * size))]);
        bytes.extend(&long);
        let entry = [&at.to_le_bytes()[..], &(long.len() as u64).to_le_bytes(), &text(b"another")].concat();
        as_recording(dir, &closed(bytes, &record(METADATA_INDEX, &entry).repeat(4 * size)))
    };
    assert_bounded("entries that lead to one record", make, 1000);
}

/// Indexes that lead to one index, which leads to the same bytes over and over.
#[test]
fn indexes_may_name_the_same_bytes_over_and_over() {
    let make = |dir: &Path, size: usize| {
        let (mut bytes, mark) = open_end();
        let (at, length) = (bytes.len() + 100, 50 * size);
        bytes.extend(record(0x80, &vec![b'.'; length + 200]));
        let frames = vec![format!("[0,0,{at},{length}]"); size].join(",");
        let index = format!("{{\"frames\":[{frames}],\"gaps\":[]}}");
        let place = bytes.len() + 9;
        bytes.extend(record(0x80, index.as_bytes()));
        let crc = crc32(index.as_bytes()).to_string();
        let one = metadata(
            "fourdbody.segment",
            &[
                ("segment", "0"),
                ("first_trigger", "0"),
                ("index_offset", &place.to_string()),
                ("index_length", &index.len().to_string()),
                ("index_crc32", &crc),
                ("session_mark", &mark),
            ],
        );
        bytes.extend(one.repeat(size));
        as_recording(dir, &closed(bytes, &[]))
    };
    assert_bounded("indexes that lead to one index", make, 500);
}

fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
        }
    }
    !crc
}

/// Triggers of a warm-up so far apart that what lies between them fills the memory: 1.9 GB, of 20 kB.
#[test]
fn triggers_far_apart_do_not_ask_for_those_between_them() {
    let make = |dir: &Path, size: usize| {
        let path = dir.join("node-a");
        let mut recording = Recording::create(&path, header("a", &["h0_up"], None), options(1 << 30))
            .expect("a new recording");
        for n in 0..size as i64 {
            let (number, hsu_time_ns) = (-1_000_000 + n * 999_999, 1_000 + n as u64);
            let event = WarmUp::Trigger { number, hsu_time_ns }.event(None, hsu_time_ns);
            recording.event(&event).expect("recorded");
        }
        let (meta, message) = frame("h0_up", 0, 0);
        recording.trigger(&trigger(0)).expect("recorded");
        recording.frame(0, &meta, &message).expect("recorded");
        recording.tick().expect("kept");
        drop(recording);
        path
    };
    let dir = quick_dir();
    cost_of_all("triggers far apart", &make(dir.path(), 120), 0);
}

/// A camera's clock that was set anew between any two exchanges: all of them would be asked about every frame.
#[test]
fn a_clock_that_is_set_all_the_time_is_none() {
    let make = |dir: &Path, size: usize| {
        let path = dir.join("node-a");
        let mut recording = Recording::create(&path, header("a", &["h0_up"], None), options(1 << 30))
            .expect("a new recording");
        let began = trigger(0).host_time_ns;
        let mut sample = |camera: Option<&str>, host_send_ns: u64, device_time_ns: u64| {
            let camera = camera.map(CameraId::from);
            let host_receive_ns = host_send_ns + 1000;
            let sample = ClockSample { camera, host_send_ns, host_receive_ns, device_time_ns };
            recording.clock_sample(&sample).expect("recorded");
        };
        (0..20).for_each(|n| sample(None, began + n * 50_000_000, 5_000 + n * 50_000_000));
        for n in 0..size as u64 {
            let at = began + n * 10_000;
            // Each of them is in force at every frame.
            sample(Some("h0_up"), at, n * 1_000_000_000);
            sample(Some("h0_up"), at + 40_000_000_000, n * 1_000_000_000 + 40_000_000_000);
        }
        for n in 0..size as u64 {
            let (meta, message) = frame("h0_up", 0, n);
            recording.trigger(&trigger(n)).expect("recorded");
            recording.frame(0, &meta, &message).expect("recorded");
        }
        recording.tick().expect("kept");
        drop(recording);
        path
    };
    assert_bounded("a clock that is set all the time", make, 500);
}

/// Many segments without a frame beside one with many: who looks for the last frame of each looks through all.
#[test]
fn segments_without_frames_do_not_cost_the_frames_of_others() {
    let make = |dir: &Path, size: usize| {
        let (mut bytes, _) = open_end();
        let header_end = {
            let at = MAGIC.len();
            let first =
                at + 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("8 bytes")) as usize;
            first + 9 + u64::from_le_bytes(bytes[first + 1..first + 9].try_into().expect("8 bytes")) as usize
        };
        let (empty, channel) = (bytes[..header_end].to_vec(), image_channel(&bytes));
        for sequence in 0..100 * size as u32 {
            // Channel, sequence, two times; no payload.
            let message = [&channel.to_le_bytes()[..], &sequence.to_le_bytes(), &[0; 16]].concat();
            bytes.extend(record(MESSAGE, &message));
        }
        let path = as_recording(dir, &bytes);
        for number in 1..=size {
            std::fs::write(path.join(format!("segment-{number:03}.mcap")), &empty).expect("writable");
        }
        path
    };
    assert_bounded("segments without frames", make, 60);
}

/// The channel of the first message: the file begins with its schemas, channels and a row of the trigger table, and the images of
/// the first camera come first among the channels.
fn image_channel(bytes: &[u8]) -> u16 {
    let topic = text(b"/camera/h0_up/image");
    let at = bytes.windows(topic.len()).position(|window| window == topic).expect("the channel");
    u16::from_le_bytes(bytes[at - 4..at - 2].try_into().expect("2 bytes"))
}

/// Lengths and counts that no file has, at every kind of record, and records within records.
#[test]
fn lengths_and_counts_that_cannot_be_are_not_believed() {
    let dir = quick_dir();
    let (good, mark) = open_end();
    let mut tried = Vec::new();
    for opcode in [1, FOOTER, 3, 4, MESSAGE, CHUNK, 7, 8, METADATA, METADATA_INDEX, 14, DATA_END, 0x80] {
        for length in [u64::MAX, 1 << 62, 1 << 40, 600 << 20] {
            let body = [&[opcode][..], &length.to_le_bytes(), &[0xff; 200]].concat();
            tried.push((format!("opcode {opcode} of {length} bytes"), body));
        }
    }
    for count in [u32::MAX, 1 << 31, 1 << 16] {
        let count = count.to_le_bytes();
        let name = text(b"fourdbody.segment");
        tried.push((format!("{count:?} entries"), record(METADATA, &[&name[..], &count, &[0; 64]].concat())));
        let inner = text(&[&count[..], b"key"].concat());
        tried.push((format!("a key of {count:?}"), record(METADATA, &[name, inner].concat())));
        tried.push((format!("a name of {count:?}"), record(METADATA, &[&count[..], &[0; 64]].concat())));
        tried.push((
            format!("a topic of {count:?}"),
            record(4, &[&[9, 0, 0, 0][..], &count, &[0; 64]].concat()),
        ));
    }
    // Chunks within chunks, each as long as what is left.
    let mut nested = Vec::new();
    for _ in 0..100 {
        let length = (nested.len() as u64).to_le_bytes();
        nested = record(CHUNK, &[&[0; 16][..], &length, &[0; 8], &length, &nested].concat());
    }
    tried.push(("chunks within chunks".to_owned(), nested));
    // Chunks that lie over each other: the first one claims all that follows.
    let length = (1u64 << 20).to_le_bytes();
    let begin =
        [&[CHUNK][..], &((1u64 << 20) + 40).to_le_bytes(), &[0; 16], &length, &[0; 8], &length].concat();
    tried.push(("chunks that overlap".to_owned(), begin.repeat(100)));
    let verdict = r#"{"status":"complete","triggers":3,"triggers_expected":3,"triggers_emitted":18446744073709551615,"cameras":[],"refused":18446744073709551615,"aborted":null}"#;
    let records = u64::MAX.to_string();
    let entries = [("json", verdict), ("records", records.as_str()), ("session_mark", mark.as_str())];
    tried.push(("a verdict beyond all counts".to_owned(), metadata("fourdbody.verdict", &entries)));
    for (what, body) in tried {
        for bytes in [[&good[..], &body].concat(), closed([&good[..], &body].concat(), &[])] {
            let path = as_recording(dir.path(), &bytes);
            let path = path.to_str().expect("UTF-8");
            assert_eq!(cost(&["info", path]).0, Some(0), "info: {what}");
            assert_eq!(cost(&["verify", path]).0, Some(4), "verify: {what}");
        }
    }
}
