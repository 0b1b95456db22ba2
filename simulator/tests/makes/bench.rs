// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera of any make on a bench: a plain GVCP client, a receiver of frames, and a wire to trigger it.

use crossbeam_channel::{Sender, unbounded};
use fourdbody_simulator::gige::gvcp::{self, Command, Request};
use fourdbody_simulator::gige::make::table::Table;
use fourdbody_simulator::gige::{CameraOptions, Habits, Make, SimulatedCamera, TestImages};
use fourdbody_simulator::images::ImageSource;
use fourdbody_simulator::wire::TriggerEdge;
use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

pub const WIDTH: usize = 64;
pub const HEIGHT: usize = 48;

/// The status of GigE Vision for success.
pub const OK: u16 = 0;
pub const INVALID: u16 = 0x8002;
pub const PROTECTED: u16 = 0x8004;
pub const DENIED: u16 = 0x8006;

/// A camera that has what cameras have.
pub const ANY: &str = r#"{"vendor": "Any", "model": "Camera", "features": {
    "AcquisitionFrameRate": {"type": "float", "unit": "Hz", "min": "depends", "max": "depends"},
    "AcquisitionFrameRateEnable": {"type": "boolean"},
    "AcquisitionMode": {"type": "enumeration", "entries": ["Continuous", "SingleFrame"]},
    "AcquisitionStart": {"type": "command", "access": "WO"},
    "AcquisitionStop": {"type": "command", "access": "WO"},
    "BinningHorizontal": {"type": "integer", "min": 1, "max": 4},
    "BinningVertical": {"type": "integer", "min": 1, "max": 4},
    "ChunkModeActive": {"type": "boolean"},
    "DecimationHorizontal": {"type": "integer", "min": 1, "max": 4},
    "ExposureAuto": {"type": "enumeration", "entries": ["Off", "Once", "Continuous"]},
    "ExposureMode": {"type": "enumeration", "entries": ["Timed", "TriggerWidth"]},
    "ExposureTime": {"type": "float", "unit": "us", "min": "depends", "max": "depends", "locked_by": true},
    "ExposureTimeRaw": {"type": "integer", "min": "depends", "max": "depends", "locked_by": true},
    "Gain": {"type": "float", "unit": "dB", "min": 0, "max": 24, "locked_by": true},
    "GainAuto": {"type": "enumeration", "entries": ["Off", "Continuous"]},
    "Gamma": {"type": "float", "min": "depends", "max": "depends"},
    "GammaEnable": {"type": "boolean"},
    "GevPersistentIPAddress": {"type": "integer"},
    "GevSCPSPacketSize": {"type": "integer", "min": 220, "max": 1500, "inc": 4},
    "GevTimestampControlLatch": {"type": "command"},
    "GevTimestampValue": {"type": "integer"},
    "Height": {"type": "integer", "min": "depends", "max": "depends", "inc": 2},
    "LUTEnable": {"type": "boolean"},
    "OffsetX": {"type": "integer", "min": 0, "max": "depends", "inc": 4},
    "PayloadSize": {"type": "integer", "access": "RO"},
    "PixelFormat": {"type": "enumeration", "entries": ["Mono8", "Mono12p", "BayerRG8"]},
    "ReverseX": {"type": "boolean"},
    "SequencerMode": {"type": "enumeration", "entries": ["Off", "On"]},
    "TestPattern": {"type": "enumeration", "entries": ["Off", "Ramp"]},
    "TriggerActivation": {"type": "enumeration", "entries": ["RisingEdge", "FallingEdge", "AnyEdge"]},
    "TriggerDelay": {"type": "float", "unit": "us", "min": 0, "max": "depends"},
    "TriggerMode": {"type": "enumeration", "entries": ["Off", "On"]},
    "TriggerOverlap": {"type": "enumeration", "entries": ["Off", "ReadOut"]},
    "TriggerSelector": {"type": "enumeration",
        "entries": ["AcquisitionStart", "FrameStart", "FrameBurstStart"],
        "selects": ["TriggerMode", "TriggerSource", "TriggerActivation", "TriggerOverlap", "TriggerSoftware"]},
    "TriggerSoftware": {"type": "command", "available_if": true},
    "TriggerSource": {"type": "enumeration", "entries": ["Software", "Line1", "Line2"]},
    "UserSetLoad": {"type": "command"},
    "UserSetSave": {"type": "command"},
    "UserSetSelector": {"type": "enumeration", "entries": ["Default", "UserSet1"]},
    "Width": {"type": "integer", "min": 16, "max": "depends", "inc": 4},
    "WidthMax": {"type": "integer"}}}"#;

/// The camera above, as the last user left it.
pub fn any(left_over: &[(&str, &str)]) -> Make {
    let make = Make::new(Table::parse(ANY).expect("a table")).expect("a make");
    left_over.iter().fold(make, |make, (name, value)| make.left_over(name, value).expect("a value of it"))
}

/// The tables of real cameras; none, with a printed reason, where they are not.
pub fn tables() -> Vec<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for place in ["../../shared/data/cameras", "../../../shared/data/cameras"] {
        let Ok(folder) = std::fs::read_dir(root.join(place)) else { continue };
        let files = folder.filter_map(|entry| Some(entry.ok()?.path()));
        let mut tables: Vec<PathBuf> =
            files.filter(|path| path.extension().is_some_and(|end| end == "json")).collect();
        tables.sort();
        return tables;
    }
    println!("skipped: there are no tables of real cameras beside the project");
    Vec::new()
}

/// A frame as it came.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    pub payload_type: u16,
    pub timestamp: u64,
    pub format: u32,
    pub width: usize,
    pub height: usize,
    pub bytes: Vec<u8>,
}

pub struct Bench {
    pub camera: SimulatedCamera,
    pub make: Arc<Make>,
    pub wire: Sender<TriggerEdge>,
    pub images: Arc<TestImages>,
    control: UdpSocket,
    stream: UdpSocket,
    next_id: u16,
}

/// How long a packet may take on a busy machine, and how long it takes to see that none comes.
const PATIENCE: Duration = Duration::from_secs(10);
const SILENCE: Duration = Duration::from_millis(400);

impl Bench {
    /// At the address 127.23.`subnet`.`host`, in control.
    pub fn new(place: (u8, u8), make: Make, habits: Habits) -> Self {
        let mut bench = Self::without_control(place, make, habits);
        assert_eq!(bench.take_control(), OK);
        bench
    }

    pub fn without_control((subnet, host): (u8, u8), make: Make, habits: Habits) -> Self {
        let images = Arc::new(TestImages::new(WIDTH, HEIGHT, 9, 50));
        let address = Ipv4Addr::new(127, 23, subnet, host);
        let mut options = CameraOptions::new("BENCH", address, Arc::<TestImages>::clone(&images));
        let (wire, triggers) = unbounded();
        let make = Arc::new(make);
        options.triggers = triggers;
        options.habits = habits;
        options.make = Some(Arc::clone(&make));
        let camera = SimulatedCamera::start(options).expect("a camera");
        let socket = || {
            let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
            socket.set_read_timeout(Some(PATIENCE)).expect("a timeout");
            socket
        };
        let (control, stream) = (socket(), socket());
        control.connect(SocketAddrV4::new(address, gvcp::PORT)).expect("a route");
        Self { camera, make, wire, images, control, stream, next_id: 1 }
    }

    /// Control, and where frames shall go.
    pub fn take_control(&mut self) -> u16 {
        let port = self.stream.local_addr().expect("an address").port();
        let status = self.write(0x0a00, &2u32.to_be_bytes());
        self.write(0x0d18, &Ipv4Addr::LOCALHOST.to_bits().to_be_bytes());
        self.write(0x0d00, &u32::from(port).to_be_bytes());
        status
    }

    pub fn move_client(&mut self, address: Ipv4Addr) {
        self.control.connect(SocketAddrV4::new(address, gvcp::PORT)).expect("a route");
    }

    pub fn send(&mut self, command: Command) -> u16 {
        let request = Request { id: self.next_id, ack: true, command };
        self.next_id += 1;
        self.control.send(&request.encode()).expect("sent");
        request.id
    }

    /// One datagram of the camera: status, command, payload. `None` where none comes.
    pub fn answer(&mut self, id: u16, patience: Duration) -> Option<(u16, u16, Vec<u8>)> {
        self.control.set_read_timeout(Some(patience)).expect("a timeout");
        let mut buffer = [0; 600];
        let length = self.control.recv(&mut buffer).ok()?;
        let word = |at: usize| u16::from_be_bytes([buffer[at], buffer[at + 1]]);
        assert_eq!(word(6), id, "the answer to another request");
        Some((word(0), word(2), buffer[8..length].to_vec()))
    }

    pub fn ask(&mut self, command: Command) -> (u16, Vec<u8>) {
        let id = self.send(command);
        let (status, _, payload) = self.answer(id, PATIENCE).expect("an answer");
        (status, payload)
    }

    pub fn write(&mut self, address: u32, data: &[u8]) -> u16 {
        self.ask(Command::WriteMemory { address, data: data.to_vec() }).0
    }

    pub fn read(&mut self, address: u32, count: u16) -> Result<Vec<u8>, u16> {
        match self.ask(Command::ReadMemory { address, count }) {
            (OK, payload) => Ok(payload[4..].to_vec()),
            (status, _) => Err(status),
        }
    }

    /// Sets a feature as its text; the status.
    pub fn set(&mut self, name: &str, value: &str) -> u16 {
        let bytes = self.make.bytes(name, value).unwrap_or_else(|e| panic!("{name} = {value}: {e}"));
        self.write(self.make.register(name).expect("there").0, &bytes)
    }

    pub fn set_all(&mut self, settings: &[(&str, &str)]) {
        for (name, value) in settings {
            assert_eq!(self.set(name, value), OK, "{name} = {value}");
        }
    }

    pub fn execute(&mut self, name: &str) -> u16 {
        self.write(self.make.register(name).expect("there").0, &1u32.to_be_bytes())
    }

    pub fn bytes(&mut self, name: &str) -> Vec<u8> {
        let (address, length) = self.make.register(name).expect("there");
        self.read(address, length as u16).unwrap_or_else(|status| panic!("{name}: {status:#x}"))
    }

    pub fn float(&mut self, name: &str) -> f64 {
        f64::from_be_bytes(self.bytes(name).try_into().expect("8 bytes"))
    }

    pub fn integer(&mut self, name: &str) -> i64 {
        let bytes = self.bytes(name);
        match <[u8; 8]>::try_from(&bytes[..]) {
            Ok(bytes) => i64::from_be_bytes(bytes),
            Err(_) => i64::from(u32::from_be_bytes(bytes.try_into().expect("4 bytes"))),
        }
    }

    /// Waits for edges of the line, then starts.
    pub fn triggered(&mut self) {
        self.set_all(&[("TriggerSelector", "FrameStart"), ("TriggerMode", "On"), ("TriggerSource", "Line1")]);
        assert_eq!(self.execute("AcquisitionStart"), OK);
    }

    /// Edges from now on, a period apart; the time of the first one.
    pub fn pulses(&self, count: i64, period: Duration, width: Duration) -> Instant {
        let start = Instant::now();
        for instant in 0..count {
            let time = start + period * instant as u32;
            let width_ns = width.as_nanos() as u64;
            self.wire.send(TriggerEdge { instant, time, width_ns }).expect("a camera");
        }
        start
    }

    /// Pixels of the light at an instant.
    pub fn light(&self, instant: i64) -> Vec<u8> {
        self.images.pixels(instant).to_vec()
    }

    /// The next frame; `None` where none comes for a while.
    pub fn frame(&self) -> Option<Frame> {
        let mut parts: BTreeMap<u32, Vec<u8>> = BTreeMap::new();
        let mut buffer = vec![0; 70_000];
        loop {
            let wait = if parts.is_empty() { SILENCE } else { PATIENCE };
            self.stream.set_read_timeout(Some(wait)).expect("a timeout");
            let length = self.stream.recv(&mut buffer).ok()?;
            let id = u32::from_be_bytes([0, buffer[5], buffer[6], buffer[7]]);
            match buffer[4] {
                2 => break,
                _ => drop(parts.insert(id, buffer[8..length].to_vec())),
            }
        }
        let leader = parts.remove(&0).expect("a leader");
        let word = |at: usize| u32::from_be_bytes(leader[at..at + 4].try_into().expect("4 bytes"));
        Some(Frame {
            payload_type: u16::from_be_bytes([leader[2], leader[3]]),
            timestamp: u64::from(word(4)) << 32 | u64::from(word(8)),
            format: word(12),
            width: word(16) as usize,
            height: word(20) as usize,
            bytes: parts.into_values().flatten().collect(),
        })
    }

    /// All frames until none comes.
    pub fn frames(&self) -> Vec<Frame> {
        std::iter::from_fn(|| self.frame()).collect()
    }
}
