// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera behind a description that was published for a real one: the description lies in its memory, as cameras have
//! it, and its features are registers at the places that the description names.
//!
//! What firmware does besides is little, and is given as facts: commands that are done at once, and registers of which
//! there is one behind every value of a selector although they share an address. What the camera then does with its
//! frames is not read from the registers here: another implementation of GenICam reads them, and reports it
//! ([`Described::work_as`]).

use super::settings::Settings;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Where the description lies; what descriptions name is elsewhere.
pub const FILE_ADDRESS: u32 = 0x7000_0000;

/// What a command does besides being done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Does {
    Start,
    Stop,
    /// Loads the settings of delivery.
    Load,
    /// Nothing that is seen here.
    Nothing,
}

/// A command: these bits of a register, written so.
#[derive(Debug, Clone, Deserialize)]
pub struct Command {
    address: u32,
    mask: u32,
    value: u32,
    does: Does,
}

/// Registers behind selectors: by their addresses, those of the selectors.
type Banks = BTreeMap<u32, Vec<u32>>;

/// The registers of a described camera that have an effect.
#[derive(Debug, Clone, Default, Deserialize)]
pub struct Facts {
    commands: Vec<Command>,
    #[serde(with = "pairs")]
    banks: Banks,
}

/// One word of memory: its address, the words of the selectors that it lies behind, and its value.
pub type Word = (u32, Vec<u32>, u32);

#[derive(Debug, Default)]
struct Inner {
    facts: Facts,
    memory: BTreeMap<(u32, Vec<u32>), u32>,
    /// What `UserSetLoad` loads; without it that command does nothing.
    delivered: Option<BTreeMap<(u32, Vec<u32>), u32>>,
    works_as: Option<Settings>,
    bootstrap: Vec<(u32, u32)>,
}

/// A description, and the memory behind it.
#[derive(Debug)]
pub struct Described {
    name: String,
    file: Vec<u8>,
    length: usize,
    inner: Mutex<Inner>,
}

/// What a command that was written does to the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Done {
    Nothing,
    Start,
    Stop,
}

impl Described {
    /// A camera with a description's file, XML or zipped XML, and with an empty memory.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn load(path: &Path) -> std::io::Result<Self> {
        let mut file = std::fs::read(path)?;
        let zipped = file.starts_with(b"PK");
        if !zipped && let Some(begin) = file.windows(2).position(|two| two == b"<?" || two == b"<R") {
            // Who saves one may put a line of his own before it.
            file.drain(..begin);
        }
        let length = file.len();
        file.resize(length.next_multiple_of(4), 0);
        let name = if zipped { "camera.zip" } else { "camera.xml" };
        Ok(Self { name: name.to_owned(), file, length, inner: Mutex::new(Inner::default()) })
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What its registers do, and hold; `delivered` is what the settings of delivery are, where they can be loaded.
    pub fn set(&self, facts: Facts, memory: Vec<Word>, delivered: Option<Vec<Word>>) {
        let map =
            |words: Vec<Word>| words.into_iter().map(|(at, behind, word)| ((at, behind), word)).collect();
        let mut inner = self.inner();
        (inner.facts, inner.memory) = (facts, map(memory));
        (inner.delivered, inner.works_as) = (delivered.map(map), None);
    }

    /// All words that were set or written.
    pub fn memory(&self) -> Vec<Word> {
        let inner = self.inner();
        inner.memory.iter().map(|((at, behind), word)| (*at, behind.clone(), *word)).collect()
    }

    /// The way in which it takes frames from its next start on.
    pub fn work_as(&self, settings: Settings) {
        self.inner().works_as = Some(settings);
    }

    /// The registers of the standard as they were after the last write: address and word.
    pub fn bootstrap(&self) -> Vec<(u32, u32)> {
        self.inner().bootstrap.clone()
    }

    pub(super) fn note(&self, bootstrap: Vec<(u32, u32)>) {
        self.inner().bootstrap = bootstrap;
    }

    pub(super) fn works_as(&self) -> Option<Settings> {
        self.inner().works_as.clone()
    }

    /// The content of the register with the description's place.
    pub(super) fn url(&self) -> String {
        format!("Local:{};{FILE_ADDRESS:x};{:x}", self.name, self.length)
    }

    /// The four bytes at an aligned address; what was never written is zero.
    pub(super) fn word(&self, address: u32) -> [u8; 4] {
        let offset = address.checked_sub(FILE_ADDRESS).and_then(|offset| usize::try_from(offset).ok());
        if let Some(bytes) = offset.and_then(|at| self.file.get(at..at.checked_add(4)?)) {
            return bytes.try_into().unwrap_or_default();
        }
        self.inner().read(address).to_be_bytes()
    }

    /// Writes whole words, and does what a command asks for.
    pub(super) fn write(&self, address: u32, data: &[u8]) -> Done {
        let mut inner = self.inner();
        let mut done = Done::Nothing;
        for (at, bytes) in (address..).step_by(4).zip(data.chunks_exact(4)) {
            let word = u32::from_be_bytes(bytes.try_into().unwrap_or_default());
            match inner.write(at, word) {
                Done::Nothing => {}
                other => done = other,
            }
        }
        done
    }
}

impl Inner {
    fn place(&self, address: u32) -> (u32, Vec<u32>) {
        let by = self.facts.banks.get(&address).map_or(&[][..], Vec::as_slice);
        (address, by.iter().map(|selector| self.read(*selector)).collect())
    }

    fn read(&self, address: u32) -> u32 {
        let place = self.place(address);
        // Behind a selector's value that was never used the word is the one of all values.
        let plain = || self.memory.get(&(address, Vec::new()));
        self.memory.get(&place).or_else(plain).copied().unwrap_or(0)
    }

    fn write(&mut self, address: u32, word: u32) -> Done {
        let mut command = self.facts.commands.iter().filter(|command| command.address == address);
        let Some(command) = command.find(|command| word & command.mask == command.value).cloned() else {
            let place = self.place(address);
            self.memory.insert(place, word);
            return Done::Nothing;
        };
        // What is loaded is there before the command is done.
        if command.does == Does::Load
            && let Some(delivered) = &self.delivered
        {
            self.memory.clone_from(delivered);
        }
        // It is done when its bits are other ones, unless these name which of two commands was the last: one is zero.
        let place = self.place(address);
        let same = |other: &&Command| other.address == address && other.mask == command.mask;
        let others = self.facts.commands.iter().filter(same);
        let is_pair = others.clone().count() > 1 && others.clone().any(|other| other.value == 0);
        let done = match is_pair {
            true => word,
            false if command.value == 0 => word | command.mask,
            false => word & !command.mask,
        };
        self.memory.insert(place, done);
        match command.does {
            Does::Start => Done::Start,
            Does::Stop => Done::Stop,
            Does::Load | Does::Nothing => Done::Nothing,
        }
    }
}

/// Keys of JSON are texts, addresses are not.
mod pairs {
    use super::{Banks, Deserialize};
    use serde::Deserializer;

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Banks, D::Error> {
        Ok(Vec::<(u32, Vec<u32>)>::deserialize(from)?.into_iter().collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn described(facts: &str, delivered: Option<Vec<Word>>) -> Described {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("a.xml");
        std::fs::write(&path, "Some Camera (1.2.3.4)\n<RegisterDescription/>").expect("written");
        let described = Described::load(&path).expect("read");
        let facts = serde_json::from_str(facts).expect("facts");
        described.set(facts, vec![(0x100, vec![], 7)], delivered);
        described
    }

    #[test]
    fn the_description_lies_at_the_address_that_its_url_says_without_foreign_lines() {
        let described = described(r#"{"commands": [], "banks": []}"#, None);
        assert_eq!(described.url(), "Local:camera.xml;70000000;16");
        assert_eq!(&described.word(FILE_ADDRESS), b"<Reg");
        assert_eq!(described.word(FILE_ADDRESS + 24), [0; 4], "beyond it there is memory");
    }

    #[test]
    fn registers_behind_a_selector_are_one_for_each_of_its_values() {
        let described = described(r#"{"commands": [], "banks": [[256, [512]]]}"#, None);
        assert_eq!(described.word(0x100), 7u32.to_be_bytes(), "as it was before anybody selected");
        described.write(0x200, &1u32.to_be_bytes());
        described.write(0x100, &8u32.to_be_bytes());
        described.write(0x200, &2u32.to_be_bytes());
        assert_eq!(described.word(0x100), 7u32.to_be_bytes());
        described.write(0x200, &1u32.to_be_bytes());
        assert_eq!(described.word(0x100), 8u32.to_be_bytes());
    }

    #[test]
    fn a_command_is_done_at_once_and_settings_of_delivery_come_back() {
        let facts = r#"{"commands": [
            {"address": 768, "mask": 3, "value": 1, "does": "load"},
            {"address": 768, "mask": 3, "value": 2, "does": "start"}], "banks": []}"#;
        let described = described(facts, Some(vec![(0x100, vec![], 9)]));
        assert_eq!(described.write(0x300, &6u32.to_be_bytes()), Done::Start);
        assert_eq!(described.word(0x300), 4u32.to_be_bytes(), "other bits stay");
        assert_eq!(described.write(0x300, &1u32.to_be_bytes()), Done::Nothing);
        assert_eq!(described.word(0x100), 9u32.to_be_bytes());
    }

    #[test]
    fn of_two_commands_with_the_same_bits_the_last_one_stands() {
        let facts = r#"{"commands": [
            {"address": 768, "mask": 32, "value": 0, "does": "start"},
            {"address": 768, "mask": 32, "value": 32, "does": "stop"}], "banks": []}"#;
        let described = described(facts, None);
        assert_eq!(described.write(0x300, &33u32.to_be_bytes()), Done::Stop);
        assert_eq!(described.word(0x300), 33u32.to_be_bytes());
        assert_eq!(described.write(0x300, &1u32.to_be_bytes()), Done::Start);
        assert_eq!(described.word(0x300), 1u32.to_be_bytes());
    }
}
