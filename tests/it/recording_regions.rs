// SPDX-License-Identifier: MIT OR Apache-2.0
//! Damage of every kind at every kind of place: `verify` finds it, and `recover` passes on nothing wrong and loses no frame
//! that still proves itself.
//!
//! The recording is written as nodes write it: frames from their own memory, padded envelopes, private records, segments.

use crate::crash::Random;
use crate::recording::{end, header, options, quick_dir, trigger};
use fourdbody::base::ids::{BlockId, CameraId, TriggerIndex};
use fourdbody::host::frame_memory::Block;
use fourdbody::record::envelope::pixels_crc;
use fourdbody::record::recover::{RecoverError, Recovery, recover};
use fourdbody::record::verify::{Severity, verify};
use fourdbody::record::{
    ClockSample, FrameMeta, GapCause, NodeEvent, Recording, RecordingHeader, SessionReader, parse_envelope,
};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

pub const CAMERAS: [&str; 2] = ["h0_up", "h0_low"];
pub const TRIGGERS: u64 = 30;
/// Two pages but for 80 bytes: the first page of a frame goes to the disk from its own memory, the rest is staged, and what is
/// left of the second is too little for the next envelope, so that a private record of zeros goes in front of it.
const SIZE: (u32, u32) = (104, 78);
const GAP: (usize, u64) = (1, 4);

fn fill(pixels: &mut [u8], salt: u64, camera: usize, index: u64) {
    let mut random = Random(salt << 32 | index << 8 | camera as u64);
    pixels.fill_with(|| random.below(256) as u8);
}

/// `later_ns`: when it was created, after others.
fn header_of(node: &str, session_id: &str, later_ns: u64) -> RecordingHeader {
    let mut header = header(node, &CAMERAS, Some(TRIGGERS));
    header.cameras.iter_mut().for_each(|camera| (camera.width, camera.height) = SIZE);
    header.session_id = session_id.to_owned();
    header.created_ns += later_ns;
    // The rig would be most of the file.
    header.rig_text = "rig".to_owned();
    header
}

/// Records a session as a node does; `salt` chooses the pixels.
fn record(dir: &Path, header: RecordingHeader, salt: u64) {
    let mut recording = Recording::create(dir, header, options(160_000)).expect("created");
    for index in 0..TRIGGERS {
        recording.trigger(&trigger(index)).expect("recorded");
        let host_time_ns = trigger(index).host_time_ns;
        let (host_send_ns, host_receive_ns) = (host_time_ns, host_time_ns + 900);
        let sample = ClockSample { camera: None, host_send_ns, host_receive_ns, device_time_ns: 7 * index };
        recording.clock_sample(&sample).expect("recorded");
        if index % 7 == 3 {
            let (kind, message) = ("something".to_owned(), index.to_string());
            let event =
                NodeEvent { host_time_ns, kind, camera: None, trigger: Some(TriggerIndex(index)), message };
            recording.event(&event).expect("recorded");
        }
        for camera in 0..CAMERAS.len() {
            if (camera, index) == GAP {
                recording.gap(camera, TriggerIndex(index), GapCause::MissingPackets).expect("recorded");
                continue;
            }
            let mut block = Block::allocate((SIZE.0 * SIZE.1) as usize);
            let room = block.bytes().len() - block.pixels().len();
            fill(&mut block.bytes_mut()[room..], salt, camera, index);
            let meta = FrameMeta {
                trigger: TriggerIndex(index),
                block: BlockId(index + 1),
                camera_time_ns: trigger(index).hsu_time_ns,
                host_time_ns,
                width: SIZE.0,
                height: SIZE.1,
                pixels_crc: pixels_crc(block.pixels()),
            };
            recording.frame_in_place(camera, &meta, block).expect("recorded");
        }
    }
    recording.finish(end(TRIGGERS)).expect("finished");
}

/// What a byte of a segment is part of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Region {
    Magic,
    FileHeader,
    HeaderMetadata,
    Metadata,
    SchemaOrChannel,
    ChunkHeader,
    MessageHeader,
    Envelope,
    Padding,
    Pixels,
    SmallRecord,
    PrivateRecord,
    MessageIndex,
    DataEnd,
    Summary,
    Footer,
}

/// Regions of a recording; each is damaged in turn.
const REGIONS: usize = 16;

/// A good segment, taken apart as the MCAP specification says.
pub struct Anatomy {
    pub bytes: Vec<u8>,
    pub regions: BTreeMap<Region, Vec<Range<usize>>>,
    /// Starts and ends of chunks.
    chunks: Vec<usize>,
    /// Offsets of the ends of all records, bytes.
    ends: Vec<usize>,
    /// Camera, trigger, and where the message is.
    pub frames: Vec<(usize, u64, Range<usize>)>,
}

impl Anatomy {
    fn of(bytes: Vec<u8>) -> Self {
        let mut own =
            Self { bytes, regions: BTreeMap::new(), chunks: Vec::new(), ends: vec![8], frames: Vec::new() };
        let length = own.bytes.len();
        own.add(Region::Magic, 0..8);
        own.add(Region::Magic, length - 8..length);
        let (mut position, mut summary) = (8, false);
        while position < length - 8 {
            let stated = own.bytes[position + 1..position + 9].try_into().expect("8 bytes");
            let (start, body) = (position, position + 9);
            let end = body + u64::from_le_bytes(stated) as usize;
            position = end;
            match own.bytes[start] {
                0x02 => own.add(Region::Footer, start..end),
                _ if summary => own.add(Region::Summary, start..end),
                0x01 => own.add(Region::FileHeader, start..end),
                0x03 | 0x04 => own.add(Region::SchemaOrChannel, start..end),
                0x05 => own.message(start, body + 22, end),
                0x06 => {
                    own.add(Region::ChunkHeader, start..body + 40);
                    own.chunks.extend([start, end]);
                    // Goes on inside.
                    position = body + 40;
                    continue;
                }
                0x07 => own.add(Region::MessageIndex, start..end),
                0x0C if own.bytes[body..end].windows(16).any(|w| w == b"fourdbody.header") => {
                    own.add(Region::HeaderMetadata, start..end);
                }
                0x0C => own.add(Region::Metadata, start..end),
                0x0F => {
                    own.add(Region::DataEnd, start..end);
                    summary = true;
                }
                0x80.. => own.add(Region::PrivateRecord, start..end),
                other => panic!("opcode {other:#x} at {start}"),
            }
            own.ends.push(end);
        }
        own
    }

    fn add(&mut self, region: Region, range: Range<usize>) {
        self.regions.entry(region).or_default().push(range);
    }

    fn message(&mut self, start: usize, payload: usize, end: usize) {
        self.add(Region::MessageHeader, start..payload);
        let Ok(envelope) = parse_envelope(&self.bytes[payload..end]) else {
            return self.add(Region::SmallRecord, payload..end);
        };
        let camera = CAMERAS.iter().position(|name| *name == envelope.camera).expect("ours");
        let (index, pixels) = (envelope.meta.trigger.0, payload + envelope.pixels.start);
        // The padding's tag, 1007 << 3 | 2 as a varint.
        let tag =
            self.bytes[payload..pixels].windows(2).position(|w| w == [0xfa, 0x3e]).map(|at| payload + at);
        match tag {
            Some(tag) if pixels - tag > 40 => {
                self.add(Region::Envelope, payload..tag);
                self.add(Region::Padding, tag..pixels - 12);
            }
            _ => self.add(Region::Envelope, payload..pixels),
        }
        self.add(Region::Pixels, pixels..end);
        self.frames.push((camera, index, payload..end));
    }
}

/// The good recording: header, segments taken apart. Made once.
pub fn good() -> &'static Vec<Anatomy> {
    static GOOD: OnceLock<Vec<Anatomy>> = OnceLock::new();
    GOOD.get_or_init(|| {
        let dir = quick_dir();
        let path = dir.path().join("node-a");
        record(&path, header_of("a", "5f0c", 17), 0);
        let count = std::fs::read_dir(&path).expect("a directory").count();
        assert!(count >= 3, "{count} segments");
        let read = |n| std::fs::read(path.join(format!("segment-{n:03}.mcap"))).expect("readable");
        (0..count).map(|n| Anatomy::of(read(n))).collect()
    })
}

/// What was made of a damaged recording.
struct Saved {
    recovery: Recovery,
    frames: BTreeSet<(usize, u64)>,
    reader: SessionReader,
    _dir: tempfile::TempDir,
}

/// The good recording with damage done to it.
struct Damaged {
    segments: Vec<Option<Vec<u8>>>,
    /// Per segment, bytes that are not as they were.
    touched: Vec<Vec<Range<usize>>>,
}

impl Damaged {
    fn new() -> Self {
        let segments: Vec<_> = good().iter().map(|segment| Some(segment.bytes.clone())).collect();
        Self { touched: vec![Vec::new(); segments.len()], segments }
    }

    fn bytes(&mut self, segment: usize) -> &mut Vec<u8> {
        self.segments[segment].as_mut().expect("there")
    }

    fn flip(&mut self, segment: usize, at: usize, bit: u64) {
        if let Some(byte) = self.bytes(segment).get_mut(at) {
            *byte ^= 1 << bit;
            self.touched[segment].push(at..at + 1);
        }
    }

    fn overwrite(&mut self, segment: usize, at: usize, with: &[u8]) {
        self.bytes(segment)[at..at + with.len()].copy_from_slice(with);
        self.touched[segment].push(at..at + with.len());
    }

    fn cut(&mut self, segment: usize, at: usize) {
        self.bytes(segment).truncate(at);
        self.touched[segment].push(at..usize::MAX);
    }

    fn write(&self, dir: &Path) -> PathBuf {
        let path = dir.join("node-a");
        std::fs::create_dir(&path).expect("a new directory");
        for (number, bytes) in self.segments.iter().enumerate() {
            if let Some(bytes) = bytes {
                std::fs::write(path.join(format!("segment-{number:03}.mcap")), bytes).expect("written");
            }
        }
        path
    }

    /// Frames of which no byte was touched.
    fn whole(&self) -> BTreeSet<(usize, u64)> {
        let frames = good().iter().enumerate().filter(|(n, _)| self.segments[*n].is_some());
        frames
            .flat_map(|(n, segment)| segment.frames.iter().map(move |frame| (n, frame)))
            .filter(|(n, (_, _, at))| {
                !self.touched[*n].iter().any(|touched| touched.start < at.end && at.start < touched.end)
            })
            .map(|(_, (camera, index, _))| (*camera, *index))
            .collect()
    }

    /// Verifies, recovers, and checks what has to hold whatever was damaged. Returns what was recovered and its frames.
    fn check(&self, what: &str) -> Option<Saved> {
        let dir = quick_dir();
        let path = self.write(dir.path());
        let found = match verify(&path, &|_, _| ()) {
            Ok(report) => report.worst == Some(Severity::Corrupt),
            Err(_) => true,
        };
        assert!(found, "{what}: verify has not found it");
        let out = dir.path().join("out");
        let recovery = match recover(&path, &out, &|_, _| ()) {
            Ok(recovery) => recovery,
            Err(RecoverError::Unusable { reason, .. }) => {
                assert_eq!(self.whole().len(), 0, "{what}: {reason}");
                return None;
            }
            Err(other) => panic!("{what}: {other}"),
        };
        let report = verify(&out, &|_, _| ()).expect("readable");
        assert_ne!(report.worst, Some(Severity::Corrupt), "{what}: {:#?}", report.findings);
        let reader = SessionReader::open(&out).expect("readable");
        let saved = frames(&reader, 0);
        let lost: Vec<_> = self.whole().difference(&saved).copied().collect();
        assert!(lost.is_empty(), "{what}: whole frames were lost: {lost:?}\n{recovery:#?}");
        let unfaithful: Vec<_> = saved.difference(&self.whole()).copied().collect();
        assert!(
            unfaithful.len() <= self.touched.iter().map(Vec::len).sum(),
            "{what}: frames that were touched, but are as they were: {unfaithful:?}"
        );
        Some(Saved { recovery, frames: saved, reader, _dir: dir })
    }
}

/// All frames of a recording, each compared with the pixels that were recorded.
pub fn frames(reader: &SessionReader, salt: u64) -> BTreeSet<(usize, u64)> {
    let mut expected = vec![0; (SIZE.0 * SIZE.1) as usize];
    let mut saved = BTreeSet::new();
    for (camera, name) in CAMERAS.iter().enumerate() {
        for index in 0..reader.recordings()[0].triggers_end() {
            let outcome = reader.recorded_frame(&CameraId::from(*name), TriggerIndex(index));
            if let Ok(frame) = outcome.expect("an outcome") {
                fill(&mut expected, salt, camera, index);
                assert!(
                    frame.image.as_slice() == expected,
                    "camera {name} trigger {index} is not the original"
                );
                assert_eq!(frame.meta.block, BlockId(index + 1));
                assert_eq!(frame.meta.camera_time_ns, trigger(index).hsu_time_ns);
                saved.insert((camera, index));
            }
        }
    }
    saved
}

const ALL: usize = TRIGGERS as usize * CAMERAS.len() - 1;

#[test]
fn a_flipped_bit_in_any_region_is_found_and_costs_only_what_it_hits() {
    let mut random = Random(crate::crash::number("FOURDBODY_SEED", 1));
    let mut seen = BTreeSet::new();
    for (number, segment) in good().iter().enumerate() {
        for (region, ranges) in &segment.regions {
            seen.insert(*region);
            for _ in 0..4 {
                let range = &ranges[random.below(ranges.len() as u64) as usize];
                let at = range.start + random.below(range.len() as u64) as usize;
                let bit = random.below(8);
                let what = format!("segment {number} byte {at} bit {bit}, {region:?}");
                let mut damaged = Damaged::new();
                damaged.flip(number, at, bit);
                let Saved { recovery, frames: saved, reader, _dir } = damaged.check(&what).expect("usable");
                let recovered = &recovery.recordings[0];
                let lost = ALL - saved.len();
                let in_frame = [Region::Envelope, Region::Padding, Region::Pixels].contains(region);
                assert!(lost <= usize::from(in_frame), "{what}: {lost} frames lost\n{recovery:#?}");
                if *region == Region::Pixels {
                    // All else in the chunk is proven by the checksums that the envelopes state.
                    assert_eq!((lost, recovered.records_lost), (1, 0), "{what}: {recovery:#?}");
                    assert_eq!(reader.recordings()[0].triggers.len() as u64, TRIGGERS, "{what}");
                    assert_eq!(recovered.added[0].cause, GapCause::Damaged, "{what}");
                }
                let kept = reader.recorded_frame(&CameraId::from(CAMERAS[GAP.0]), TriggerIndex(GAP.1));
                let cause = kept.expect("an outcome").expect_err("a gap");
                assert_eq!(cause, GapCause::MissingPackets, "{what}");
            }
        }
    }
    assert_eq!(seen.len(), REGIONS, "the recording has all regions: {seen:?}");
}

#[test]
fn cut_at_every_chunk_boundary_and_at_random_bytes() {
    let mut random = Random(crate::crash::number("FOURDBODY_SEED", 1).wrapping_add(1));
    for (number, segment) in good().iter().enumerate() {
        let near = segment.chunks.iter().flat_map(|at| [at - 1, *at, at + 1]);
        let length = segment.bytes.len();
        let anywhere: Vec<usize> = (0..25).map(|_| random.below(length as u64) as usize).collect();
        for at in
            near.chain(segment.ends.iter().copied()).chain(anywhere).chain([0]).filter(|at| *at < length)
        {
            let mut damaged = Damaged::new();
            damaged.cut(number, at);
            damaged.check(&format!("segment {number} cut at {at} of {length}")).expect("usable");
        }
    }
}

#[test]
fn damage_at_several_places_at_once() {
    let mut random = Random(crate::crash::number("FOURDBODY_SEED", 1).wrapping_add(2));
    for run in 0..150 {
        let mut damaged = Damaged::new();
        let segments = good().len() as u64;
        for _ in 0..1 + random.below(9) {
            let segment = random.below(segments) as usize;
            let length = damaged.bytes(segment).len() as u64;
            if length < 10 {
                continue;
            }
            let at = random.below(length) as usize;
            match random.below(10) {
                0 => damaged.cut(segment, at),
                // Blocks that a power cut kept from the disk, or that went to the wrong place.
                1 => {
                    let size = 1 + random.below(9000).min(length - at as u64 - 1) as usize;
                    damaged.overwrite(segment, at, &vec![0; size]);
                }
                2 => {
                    let size = 1 + random.below(300).min(length - at as u64 - 1) as usize;
                    let noise: Vec<u8> = (0..size).map(|_| random.below(256) as u8).collect();
                    damaged.overwrite(segment, at, &noise);
                }
                _ => damaged.flip(segment, at, random.below(8)),
            }
        }
        if damaged.segments.iter().zip(good()).all(|(now, was)| now.as_ref() == Some(&was.bytes)) {
            // Two flips of the same bit, or zeros over zeros.
            continue;
        }
        damaged.check(&format!("run {run}: {:?}", damaged.touched));
    }
}

#[test]
fn lengths_that_are_huge_cost_nothing_but_themselves() {
    for (number, segment) in good().iter().enumerate() {
        let places = [Region::ChunkHeader, Region::MessageHeader, Region::Metadata, Region::PrivateRecord];
        for region in places {
            let Some(range) = segment.regions.get(&region).and_then(|ranges| ranges.get(ranges.len() / 2))
            else {
                continue;
            };
            for length in [u64::MAX, u64::MAX - 8, 1 << 62, 1 << 40, segment.bytes.len() as u64, 0] {
                let mut damaged = Damaged::new();
                damaged.overwrite(number, range.start + 1, &length.to_le_bytes());
                let what = format!("segment {number} {region:?} at {} of {length} bytes", range.start);
                let Saved { frames: saved, .. } = damaged.check(&what).expect("usable");
                assert_eq!(saved.len(), ALL, "{what}");
            }
        }
    }
}

/// No index leads to them: the segment was never closed.
#[test]
fn frames_without_a_record_around_them_are_found_by_their_own_bytes() {
    const BEFORE_PAYLOAD: usize = 31;
    for (number, segment) in good().iter().enumerate() {
        let last = segment.frames.last().expect("frames").2.end;
        for (camera, index, message) in &segment.frames {
            let mut damaged = Damaged::new();
            damaged.cut(number, last);
            damaged.overwrite(number, message.start - BEFORE_PAYLOAD, &[0xff; BEFORE_PAYLOAD]);
            let what = format!("segment {number}, no record around camera {camera} trigger {index}");
            let Saved { frames: saved, .. } = damaged.check(&what).expect("usable");
            assert_eq!(saved.len(), ALL, "{what}");
        }
    }
}

#[test]
fn empty_and_missing_segments_cost_only_their_own_frames() {
    for number in 0..good().len() {
        for missing in [false, true] {
            let mut damaged = Damaged::new();
            if missing {
                damaged.segments[number] = None;
            } else {
                damaged.cut(number, 0);
            }
            let what = format!("segment {number} {}", if missing { "missing" } else { "empty" });
            let Saved { recovery, frames: saved, .. } = damaged.check(&what).expect("usable");
            let own = good()[number].frames.len();
            assert_eq!(saved.len(), ALL - own, "{what}");
            let last = number + 1 == good().len();
            assert_eq!(recovery.recordings[0].interrupted, last, "{what}: the verdict is in the last one");
        }
    }
    let mut damaged = Damaged::new();
    for number in 0..good().len() {
        damaged.cut(number, 0);
    }
    assert!(damaged.check("all empty").is_none());
}

/// Another recording with other pixels; whose segments go where they do not belong.
fn another(dir: &Path, node: &str, session_id: &str) -> Vec<Vec<u8>> {
    let path = dir.join("another");
    record(&path, header_of(node, session_id, 99), 1);
    let count = std::fs::read_dir(&path).expect("a directory").count();
    let read = |n| std::fs::read(path.join(format!("segment-{n:03}.mcap"))).expect("readable");
    (0..count).map(read).collect()
}

#[test]
fn segments_of_another_recording_are_told_apart_and_left_out() {
    for (node, session_id) in [("a", "0ther"), ("b", "5f0c")] {
        let dir = quick_dir();
        let other = another(dir.path(), node, session_id);
        for number in 0..good().len() {
            for cut in [false, true] {
                let mut damaged = Damaged::new();
                let mut foreign = other[number.min(other.len() - 1)].clone();
                if cut {
                    // Not closed: only the header's own checksum says what it is.
                    foreign.truncate(foreign.len() * 2 / 3);
                }
                damaged.cut(number, 0);
                *damaged.bytes(number) = foreign;
                let what = format!("segment {number} is of session {session_id} node {node}, cut: {cut}");
                // Every frame that is passed on is compared with the original's pixels.
                let Saved { recovery, frames: saved, .. } = damaged.check(&what).expect("usable");
                assert_eq!(saved.len(), ALL - good()[number].frames.len(), "{what}");
                let named = recovery.recordings[0].damage.iter().any(|damage| {
                    damage.segment == number as u32 && damage.reason.contains("belongs to session")
                });
                assert!(named, "{what}: {recovery:#?}");
                let place = quick_dir();
                let path = damaged.write(place.path());
                let report = verify(&path, &|_, _| ()).expect("readable");
                let named = report.findings.iter().any(|f| f.message.contains("belongs to session"));
                assert!(named, "{what}: {:#?}", report.findings);
            }
        }
    }
}

#[test]
fn recordings_of_two_sessions_in_one_directory_are_not_made_one() {
    let dir = quick_dir();
    let session = dir.path().join("walk-01");
    record(&session.join("node-a"), header_of("a", "5f0c", 17), 0);
    record(&session.join("node-b"), header_of("b", "0ther", 99), 1);
    let report = verify(&session, &|_, _| ()).expect("readable");
    assert_eq!(report.worst, Some(Severity::Corrupt));
    assert!(!report.compared[0].agree);
    let out = dir.path().join("out");
    let recovery = recover(&session, &out, &|_, _| ()).expect("one of them");
    assert_eq!((recovery.recordings.len(), recovery.unusable.len()), (1, 1));
    assert!(recovery.unusable[0].contains("recover it by itself"), "{:?}", recovery.unusable);
    assert_eq!(frames(&SessionReader::open(&out).expect("readable"), 0).len(), ALL);
    let alone = dir.path().join("alone");
    recover(&session.join("node-b"), &alone, &|_, _| ()).expect("the other one");
    assert_eq!(frames(&SessionReader::open(&alone).expect("readable"), 1).len(), ALL);
}

#[test]
fn files_that_are_no_recordings_are_refused() {
    let mut random = Random(5);
    let noise: Vec<u8> = (0..20_000).map(|_| random.below(256) as u8).collect();
    let mut only_magic = noise.clone();
    only_magic[..8].copy_from_slice(b"\x89MCAP0\r\n");
    let text = b"camera,trigger\nh0_up,0\n".repeat(100);
    for (name, bytes) in [("noise", noise), ("magic", only_magic), ("text", text), ("empty", Vec::new())] {
        let dir = quick_dir();
        let path = dir.path().join("node-a");
        std::fs::create_dir(&path).expect("a new directory");
        let segment = path.join("segment-000.mcap");
        std::fs::write(&segment, bytes).expect("written");
        for path in [&path, &segment] {
            assert!(SessionReader::open(path).is_err(), "{name}");
            assert!(verify(path, &|_, _| ()).is_err(), "{name}");
            let out = dir.path().join("out");
            let result = recover(path, &out, &|_, _| ());
            assert!(matches!(result, Err(RecoverError::Unusable { .. })), "{name}: {result:?}");
            let left: Vec<_> = std::fs::read_dir(dir.path()).expect("a directory").collect();
            assert_eq!(left.len(), 1, "{name}: nothing half-made is left: {left:?}");
        }
    }
}

/// While a segment is open, nothing but their own checksum vouches for header and other metadata.
#[test]
fn a_flip_in_the_header_of_an_interrupted_recording_is_found_and_mended_from_the_other_node() {
    let dir = quick_dir();
    let session = dir.path().join("walk-01");
    for node in ["a", "b"] {
        let mut header = header_of(node, "5f0c", 17);
        header.rig_text = format!("# a rig of some length {}\n", "x".repeat(400));
        record(&session.join(format!("node-{node}")), header, 0);
    }
    let segments = std::fs::read_dir(session.join("node-a")).expect("a directory").count();
    for number in 1..segments {
        std::fs::remove_file(session.join(format!("node-a/segment-{number:03}.mcap"))).expect("there");
    }
    let first = session.join("node-a/segment-000.mcap");
    let mut bytes = std::fs::read(&first).expect("readable");
    bytes.truncate(bytes.len() * 3 / 4);
    let rig = bytes.windows(4).position(|w| w == b"xxxx").expect("the rig");
    bytes[rig + 100] ^= 1;
    std::fs::write(&first, &bytes).expect("written");
    let report = verify(&session, &|_, _| ()).expect("readable");
    let named = report.findings.iter().any(|f| f.message.contains("fourdbody.header fails its checksum"));
    assert!(named, "{:#?}", report.findings);
    let out = dir.path().join("out");
    let recovery = recover(&session, &out, &|_, _| ()).expect("usable");
    let reasons: Vec<_> = recovery.recordings[0].damage.iter().map(|damage| &damage.reason).collect();
    assert!(reasons.iter().any(|reason| reason.contains("header fails its checksum")), "{reasons:?}");
    let reader = SessionReader::open(&out).expect("readable");
    let [a, b] = reader.recordings() else { panic!("two recordings") };
    assert_eq!(a.header.rig_text, b.header.rig_text);
}
