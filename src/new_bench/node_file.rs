// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes a node file's cameras, and what else a new file needs, without touching the rest of it: comments stay.

use crate::base::ids::CameraId;
use crate::config::{AUTO, PacketDelay};
use std::net::SocketAddr;
use std::path::PathBuf;
use toml_edit::{ArrayOfTables, DocumentMut, Item, Table, value};

/// Values for a node file before its cameras; what is `None` stays as the file has it.
#[derive(Debug, Clone, Default)]
pub struct Given {
    /// The node's name in the rig.
    pub node: Option<String>,
    /// The rig file, relative to the node file.
    pub rig: Option<PathBuf>,
    pub hsu: Option<PathBuf>,
    /// The directory in which sessions are recorded.
    pub sessions: Option<PathBuf>,
    /// Address and port of the API.
    pub listen: Option<SocketAddr>,
}

/// What is written of one camera; what is `None` stays as the file has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// Its name in the rig.
    pub id: CameraId,
    /// Its address, or its Aravis id.
    pub address: String,
    /// The line that the HSU is wired to.
    pub trigger_line: Option<String>,
    /// The time between two packets.
    pub packet_delay: Option<PacketDelay>,
    /// The comment above the entry, in one line.
    pub comment: String,
}

/// The comment that this module writes and finds again.
const COMMENT: &str = "# set up: ";

const FIRST: &str = "# Written by `fourdbody cameras setup`; check with `fourdbody check-config`, and see \
    docs/guide/new-bench.md.\n";

/// A file's text with the given values, and with defaults for the keys that every file needs and this one does not
/// have.
///
/// # Errors
/// The text is no TOML, or has something else where a table belongs.
pub fn begin(text: &str, given: &Given) -> Result<String, String> {
    let mut file = parse(text)?;
    let source = file.get("trigger").and_then(|trigger| trigger.get("source")).and_then(Item::as_str);
    if source == Some("action") {
        return Err("trigger.source is \"action\": expected an HSU, by whose pulses lines are found, and action \
            commands come by none; write the cameras' ids and addresses into the file, and try them by a session"
            .to_owned());
    }
    let path = |path: &PathBuf| path.display().to_string();
    if text.trim().is_empty() {
        file.decor_mut().set_prefix(FIRST);
    }
    set_default(file.as_table_mut(), "format", 1.into());
    set(file.as_table_mut(), "node", given.node.clone().map(Into::into));
    set(file.as_table_mut(), "rig", given.rig.as_ref().map(|rig| path(rig).into()));
    set_default(file.as_table_mut(), "rig", "rig.toml".into());
    for (section, key, given, default) in [
        ("api", "listen", given.listen.map(|listen| listen.to_string()), "127.0.0.1:7401"),
        ("hsu", "device", given.hsu.as_ref().map(path), "/dev/fourdbody-hsu"),
        ("storage", "sessions_dir", given.sessions.as_ref().map(path), "/var/lib/fourdbody/sessions"),
    ] {
        let table = table_of(&mut file, section)?;
        set(table, key, given.map(Into::into));
        // A node may listen on a socket alone.
        if section != "api" || !table.contains_key("socket") {
            set_default(table, key, default.into());
        }
    }
    table_of(&mut file, "acquisition")?;
    Ok(file.to_string())
}

/// The same text with these cameras, and with this packet size for all of them. Entries of other cameras stay.
///
/// # Errors
/// As [`begin`].
pub fn with_cameras(text: &str, entries: &[Entry], packet_bytes: Option<u32>) -> Result<String, String> {
    let mut file = parse(text)?;
    if let Some(bytes) = packet_bytes {
        set(table_of(&mut file, "acquisition")?, "packet_bytes", Some(i64::from(bytes).into()));
    }
    let cameras = file.entry("camera").or_insert_with(|| Item::ArrayOfTables(ArrayOfTables::new()));
    let expected = "camera: expected a list of tables, [[camera]]";
    let cameras = cameras.as_array_of_tables_mut().ok_or(expected)?;
    for entry in entries {
        let is_it = |table: &Table| table.get("id").and_then(Item::as_str) == Some(entry.id.as_str());
        let known = cameras.iter().position(is_it);
        let place = match known {
            Some(place) => place,
            None => {
                cameras.push(Table::new());
                cameras.len() - 1
            }
        };
        let Some(table) = cameras.get_mut(place) else { continue };
        set(table, "id", Some(entry.id.as_str().into()));
        set(table, "address", Some(entry.address.as_str().into()));
        set(table, "trigger_line", entry.trigger_line.as_deref().map(Into::into));
        set(
            table,
            "packet_delay_us",
            entry.packet_delay.map(|delay| match delay {
                PacketDelay::Auto => AUTO.into(),
                PacketDelay::Microseconds(delay) => delay.into(),
            }),
        );
        let before = table.decor().prefix().and_then(|prefix| prefix.as_str()).unwrap_or("\n").to_owned();
        let kept = before.lines().filter(|line| !line.starts_with(COMMENT));
        let mut prefix: String = kept.map(|line| format!("{line}\n")).collect();
        if prefix.is_empty() {
            prefix.push('\n');
        }
        let comment: String = entry.comment.chars().filter(|c| !c.is_control()).collect();
        table.decor_mut().set_prefix(format!("{prefix}{COMMENT}{comment}\n"));
    }
    Ok(file.to_string())
}

fn parse(text: &str) -> Result<DocumentMut, String> {
    text.parse().map_err(|e: toml_edit::TomlError| format!("not valid TOML: {e}"))
}

/// Sets a value and keeps what stands around it.
fn set(table: &mut Table, key: &str, to: Option<toml_edit::Value>) {
    let Some(mut to) = to else { return };
    if let Some(Item::Value(known)) = table.get_mut(key) {
        *to.decor_mut() = known.decor().clone();
        *known = to;
    } else {
        table.insert(key, value(to));
    }
}

fn set_default(table: &mut Table, key: &str, to: toml_edit::Value) {
    if !table.contains_key(key) {
        set(table, key, Some(to));
    }
}

fn table_of<'a>(file: &'a mut DocumentMut, name: &str) -> Result<&'a mut Table, String> {
    let item = file.entry(name).or_insert_with(|| Item::Table(Table::new()));
    item.as_table_mut().ok_or_else(|| format!("{name}: expected a table, [{name}]"))
}

#[cfg(test)]
mod tests {
    use super::{Entry, Given, begin, with_cameras};
    use crate::base::ids::CameraId;
    use crate::config::PacketDelay;

    fn entry(id: &str, comment: &str) -> Entry {
        Entry {
            id: CameraId::from(id),
            address: "192.168.10.2".to_owned(),
            trigger_line: Some("Line1".to_owned()),
            packet_delay: Some(PacketDelay::Auto),
            comment: comment.to_owned(),
        }
    }

    #[test]
    fn an_empty_file_becomes_a_whole_one_and_setting_up_again_changes_nothing() {
        let given =
            Given { node: Some("a".to_owned()), hsu: Some("/dev/ttyUSB0".into()), ..Given::default() };
        let begun = begin("", &given).expect("TOML");
        let whole =
            with_cameras(&begun, &[entry("h0_up", "one"), entry("h0_low", "two")], Some(8000)).expect("TOML");
        let table: toml::Table = whole.parse().expect("TOML");
        assert_eq!(table["node"].as_str(), Some("a"));
        assert_eq!(table["hsu"]["device"].as_str(), Some("/dev/ttyUSB0"));
        assert_eq!(table["acquisition"]["packet_bytes"].as_integer(), Some(8000));
        assert_eq!(table["camera"][1]["trigger_line"].as_str(), Some("Line1"));
        assert!(whole.contains("\n# set up: two\n[[camera]]\nid = \"h0_low\"\n"), "{whole}");
        let again = with_cameras(
            &begin(&whole, &given).expect("TOML"),
            &[entry("h0_up", "one"), entry("h0_low", "two")],
            Some(8000),
        );
        assert_eq!(again.as_deref(), Ok(whole.as_str()));
    }

    #[test]
    fn what_stands_in_a_file_stays() {
        let text = "# ours\nformat = 1\nnode = \"a\" # this one\n\n[api]\nsocket = \"/run/x\"\n\n\
                    # the upper one\n[[camera]]\nid = \"h0_up\" # by the door\naddress = \"10.0.0.1\"\n\
                    settings = [[\"BlackLevel\", 4.0]]\n";
        let text = begin(text, &Given::default()).expect("TOML");
        let first = with_cameras(&text, &[entry("h0_up", "first")], None).expect("TOML");
        let text = with_cameras(&first, &[entry("h0_up", "second")], None).expect("TOML");
        for kept in [
            "# ours\n",
            "# this one",
            "# the upper one",
            "# by the door",
            "settings = [[\"BlackLevel\", 4.0]]",
        ] {
            assert!(text.contains(kept), "{kept:?} missing in\n{text}");
        }
        assert!(text.contains("address = \"192.168.10.2\""), "{text}");
        assert!(text.contains("# set up: second") && !text.contains("first"), "{text}");
        assert!(!text.contains("listen"), "a node that listens on a socket alone stays so:\n{text}");
        assert!(
            begin("[trigger]\nsource = \"action\"", &Given::default())
                .is_err_and(|why| why.contains("pulses"))
        );
        assert!(begin("hsu = 3", &Given::default()).is_err() && begin("[", &Given::default()).is_err());
    }
}
