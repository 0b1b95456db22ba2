//! All tables of real cameras: descriptions that Aravis reads, registers that take what they say.

use crate::bench::{Bench, HEIGHT, OK, WIDTH, tables};
use fourdbody_simulator::gige::control::Control;
use fourdbody_simulator::gige::gvcp::{Command, Request};
use fourdbody_simulator::gige::make::table::{Bound, Kind};
use fourdbody_simulator::gige::network::Network;
use fourdbody_simulator::gige::registers::{Identity, Registers};
use fourdbody_simulator::gige::{CameraClock, ClockOptions, Habits, Make};
use proptest::prelude::*;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

fn tool(arguments: &[&str]) -> Option<String> {
    match std::process::Command::new("arv-tool-0.8").args(arguments).output() {
        Ok(output) => Some(String::from_utf8_lossy(&output.stdout).into_owned()),
        Err(error) => {
            println!("skipped: arv-tool-0.8: {error}");
            None
        }
    }
}

#[test]
fn aravis_reads_every_description_and_sets_features() {
    for (host, file) in (1..).zip(tables()) {
        let make = Make::load(&file).expect("a table");
        // A family's description names more than its grey camera has; of that the tool says nothing.
        let there = make.table().features.iter().filter(|feature| !feature.implemented_if);
        let names: Vec<String> = there.map(|feature| feature.name.clone()).collect();
        let bench = Bench::without_control((4, host), make, Habits::default());
        let address = bench.camera.address().to_string();
        let Some(listed) = tool(&["-a", &address, "features"]) else { return };
        for name in &names {
            assert!(listed.contains(&format!("'{name}'")), "{}: no {name} in\n{listed}", file.display());
        }
        let Some(printed) = tool(&["-a", &address, "control", "Height=32", "Height", "PayloadSize"]) else {
            return;
        };
        let lines: Vec<&str> = printed.lines().collect();
        assert!(lines.len() == 3 && lines[1].starts_with("Height = 32"), "{}: {printed}", file.display());
        assert!(
            lines[2].starts_with(&format!("PayloadSize = {}", WIDTH * 32)),
            "{}: {printed}",
            file.display()
        );
    }
}

/// Every feature takes a legal value and reads it back, or refuses.
#[test]
fn every_feature_of_every_table_takes_what_it_may_or_refuses() {
    for (host, file) in (1..).zip(tables()) {
        let make = Make::load(&file).expect("a table");
        let features = make.table().features.clone();
        let mut bench = Bench::new((5, host), make, Habits::default());
        assert_eq!((bench.integer("Width"), bench.integer("Height")), (WIDTH as i64, HEIGHT as i64));
        let mut taken = 0;
        for feature in &features {
            let (address, length) = bench.make.register(&feature.name).expect("there");
            // Those of the standard are shared by all cameras, and tested with the simulator's own.
            if address < 0x1_0000 || feature.kind == Kind::Command {
                continue;
            }
            let Ok(before) = bench.read(address, length as u16) else { continue };
            let value = match (feature.kind, feature.min, feature.max) {
                (Kind::Enumeration, ..) => feature.entries[feature.entries.len() - 1].clone(),
                (Kind::Boolean, ..) => "true".to_owned(),
                (Kind::String, ..) => "a text".to_owned(),
                (_, Bound::Fixed(min), _) => format!("{min}"),
                (_, _, Bound::Fixed(max)) => format!("{max}"),
                _ => "64".to_owned(),
            };
            let Ok(bytes) = bench.make.bytes(&feature.name, &value) else { continue };
            let status = bench.write(address, &bytes);
            let after = bench.read(address, length as u16);
            let name = format!("{}: {} = {value}", file.display(), feature.name);
            match status {
                OK => {
                    taken += 1;
                    // Where a feature selects others, or its own register is what it selects, its value stands too.
                    assert_eq!(after.map(|read| read[..bytes.len()].to_vec()), Ok(bytes), "{name}");
                }
                refused => {
                    assert!((0x8001..=0x8007).contains(&refused), "{name}: {refused:#x}");
                    assert_eq!(after, Ok(before), "{name}: refused, and changed");
                }
            }
        }
        assert!(taken >= 20, "{}: only {taken} features can be set", file.display());
    }
}

fn makes() -> &'static [Arc<Make>] {
    static MAKES: OnceLock<Vec<Arc<Make>>> = OnceLock::new();
    MAKES.get_or_init(|| {
        let mut makes: Vec<Arc<Make>> =
            tables().iter().map(|file| Arc::new(Make::load(file).expect("a table"))).collect();
        makes.push(Arc::new(crate::bench::any(&[])));
        makes
    })
}

fn device(make: &Arc<Make>) -> Control {
    let address = Ipv4Addr::new(127, 23, 6, 1);
    let clock = CameraClock::new(Instant::now(), ClockOptions::default());
    let identity =
        Identity { address, model: "M".to_owned(), serial: "S".to_owned(), user_name: String::new() };
    let network = Network::new(address);
    let sensor = (WIDTH as u32, HEIGHT as u32);
    Control::new(Registers::of_make(
        identity,
        sensor,
        Arc::new(clock),
        Habits::default(),
        Arc::clone(make),
        &network,
    ))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn no_sequence_of_writes_stops_a_camera(
        which: prop::sample::Index,
        writes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u64>(), 0u8..4, 0u64..3), 1..80),
    ) {
        let make = which.get(makes());
        let mut control = device(make);
        let (from, mut now) = (SocketAddrV4::new(Ipv4Addr::LOCALHOST, 1000), Instant::now());
        let mut send = |command, now| {
            let request = Request { id: 1, ack: true, command };
            let answer = control.handle(&request.encode(), from, now).answer.expect("an answer");
            u16::from_be_bytes([answer[0], answer[1]])
        };
        prop_assert_eq!(send(Command::WriteRegisters(vec![(0x0a00, 2)]), now), 0);
        for (feature, bits, form, wait) in writes {
            now += Duration::from_millis(wait * 100);
            let name = &feature.get(&make.table().features).name;
            let (address, length) = make.register(name).expect("there");
            let value = match form {
                0 => bits % 8,
                1 => (bits as f64 % 1e6).to_bits(),
                2 => bits % 70_000,
                _ => bits,
            };
            let mut data = value.to_be_bytes().to_vec();
            if length == 4 {
                data.drain(..4);
            }
            send(Command::WriteMemory { address, data }, now);
            send(Command::ReadMemory { address, count: length as u16 }, now);
        }
    }
}
