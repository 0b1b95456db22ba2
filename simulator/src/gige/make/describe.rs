// SPDX-License-Identifier: MIT OR Apache-2.0
//! The GenICam description of a make: every feature of its table, in the order of elements of the GenApi 1.1 schema.
//!
//! What firmware decides (bounds that depend, locks, what is there) is read from registers beside each feature's own.

use super::Make;
use super::commands::Written;
use super::places::{self, AVAILABLE, IMPLEMENTED, LOCKED, Link, Said};
use super::rules;
use super::table::{Access, Bound, Feature, Kind};
use std::fmt::Write;

/// The GenICam description of a make, XML.
pub fn xml(make: &Make) -> String {
    let table = &make.table;
    let mut xml = String::new();
    let (vendor, model) = (escaped(&table.vendor), escaped(&table.model));
    // Writing into a String cannot fail, here and below.
    let _ = write!(
        xml,
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <RegisterDescription ModelName=\"{model}\" VendorName=\"{vendor}\" \
         ToolTip=\"Simulated camera of fourdbody\" StandardNameSpace=\"GEV\" \
         SchemaMajorVersion=\"1\" SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\" \
         MajorVersion=\"1\" MinorVersion=\"0\" SubMinorVersion=\"0\" \
         ProductGuid=\"6f0f1f2c-9a1b-4d63-9b6c-4db0d1f0c003\" \
         VersionGuid=\"6f0f1f2c-9a1b-4d63-9b6c-4db0d1f0c004\" \
         xmlns=\"http://www.genicam.org/GenApi/Version_1_1\" \
         xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
         xsi:schemaLocation=\"http://www.genicam.org/GenApi/Version_1_1 GenApiSchema_Version_1_1.xsd\">\n\
         <Category Name=\"Root\" NameSpace=\"Standard\"><pFeature>Features</pFeature></Category>\n\
         <Category Name=\"Features\" NameSpace=\"Custom\">"
    );
    for feature in &table.features {
        let _ = write!(xml, "<pFeature>{}</pFeature>", feature.name);
    }
    xml.push_str("</Category>\n<Integer Name=\"NeverThere\"><Visibility>Invisible</Visibility><Value>0</Value></Integer>\n");
    for index in 0..table.features.len() {
        Node { make, index, feature: &table.features[index], xml: &mut xml }.write();
    }
    xml.push_str("<Port Name=\"Device\" NameSpace=\"Standard\"></Port>\n</RegisterDescription>\n");
    xml
}

fn escaped(text: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || "_-. ".contains(c) { c } else { '_' };
    text.chars().map(safe).collect()
}

/// A text as a document holds it, in the letters of any language.
fn plain_text(text: &str) -> String {
    text.chars().filter(|c| !c.is_control() && !"<>&".contains(*c)).collect()
}

fn access_text(access: Access) -> &'static str {
    match access {
        Access::Ro => "RO",
        Access::Rw => "RW",
        Access::Wo => "WO",
    }
}

struct Node<'a> {
    make: &'a Make,
    index: usize,
    feature: &'a Feature,
    xml: &'a mut String,
}

impl Node<'_> {
    fn put(&mut self, text: &str) {
        self.xml.push_str(text);
        self.xml.push('\n');
    }

    fn write(&mut self) {
        let link = self.make.links[self.index];
        let access = match link {
            Some(link) if self.feature.kind == Kind::Command => {
                if link.writable {
                    Access::Wo
                } else {
                    Access::Ro
                }
            }
            Some(link) => {
                if link.writable {
                    Access::Rw
                } else {
                    Access::Ro
                }
            }
            // What a client may do with a command is one thing, whether its register can be read another.
            None => match self.feature.can_be_read {
                Some(true) if self.feature.kind == Kind::Command => Access::Rw,
                Some(false) if self.feature.kind == Kind::Command => Access::Wo,
                _ => rules::access(self.feature),
            },
        };
        let name = &self.feature.name;
        let conditions = self.conditions();
        let register = format!("{name}_Sim");
        let value = format!("<pValue>{register}</pValue>");
        match self.feature.kind {
            Kind::Integer => {
                let limits = self.limits(link.is_some());
                let (unit, selected) = (self.unit(), self.selected());
                self.put(&format!(
                    "<Integer Name=\"{name}\">{conditions}{value}{limits}{unit}{selected}</Integer>"
                ));
            }
            Kind::Float => {
                let (limits, unit) = (self.limits(false), self.unit());
                self.put(&format!("<Float Name=\"{name}\">{conditions}{value}{limits}{unit}</Float>"));
            }
            Kind::Boolean => {
                let values = "<OnValue>1</OnValue><OffValue>0</OffValue>";
                self.put(&format!("<Boolean Name=\"{name}\">{conditions}{value}{values}</Boolean>"));
            }
            Kind::Command => {
                let own = match self.feature.access {
                    Some(own) if link.is_none() => {
                        format!("<ImposedAccessMode>{}</ImposedAccessMode>", access_text(own))
                    }
                    _ => String::new(),
                };
                let command = self.command(link);
                self.put(&format!("<Command Name=\"{name}\">{own}{conditions}{value}{command}</Command>"));
            }
            Kind::Enumeration => {
                let (entries, selected) = (self.entries(link), self.selected());
                self.put(&format!(
                    "<Enumeration Name=\"{name}\">{conditions}{entries}{value}{selected}</Enumeration>"
                ));
            }
            Kind::String => return self.text_register(name, link, &conditions, access),
        }
        let (address, length) = match link {
            Some(link) => (link.address, link.length),
            None => (places::value(self.index), places::length(self.feature.kind)),
        };
        let bits = link.and_then(|link| link.bits);
        let float = self.feature.kind == Kind::Float;
        self.register(&register, address, length, Form { access, bits, float, signed: link.is_none() });
        if link.is_none() {
            self.said(float);
        }
    }

    /// What is written to execute it.
    fn command(&self, link: Option<Link>) -> String {
        let fixed = |value: u32| format!("<CommandValue>{value}</CommandValue>");
        match (link, self.make.written(self.index)) {
            (Some(link), _) => fixed(link.command),
            (None, Written::Always(value)) => fixed(value),
            (None, Written::Of(of)) => {
                format!("<pCommandValue>{}_Sim</pCommandValue>", self.make.table.features[of].name)
            }
        }
    }

    /// The firmware's words on the feature.
    fn said(&mut self, float: bool) {
        let (index, name) = (self.index, self.feature.name.clone());
        if matches!(self.feature.kind, Kind::Integer | Kind::Float) {
            let named = [(Said::Min, "_SimMin"), (Said::Max, "_SimMax"), (Said::Inc, "_SimInc")];
            for (bound, (what, suffix)) in self.bounds().into_iter().zip(named) {
                if bound == Bound::Depends && !(float && what == Said::Inc) {
                    let form = Form { access: Access::Ro, bits: None, float, signed: true };
                    self.register(&format!("{name}{suffix}"), places::said(index, what), 8, form);
                }
            }
        }
        for (bit, suffix, there) in self.flags() {
            if there {
                // Bit 0 of such a node is the most significant.
                let place = 31 - bit.trailing_zeros() as u8;
                let form =
                    Form { access: Access::Ro, bits: Some((place, place)), float: false, signed: false };
                self.register(&format!("{name}{suffix}"), places::said(index, Said::State), 4, form);
            }
        }
    }

    /// Bits of the state, and whether the description looks at them.
    fn flags(&self) -> [(u32, &'static str, bool); 3] {
        let Feature { implemented_if, available_if, locked_by, .. } = *self.feature;
        [
            (IMPLEMENTED, "_SimImplemented", implemented_if),
            (AVAILABLE, "_SimAvailable", available_if),
            (LOCKED, "_SimLocked", locked_by),
        ]
    }

    fn conditions(&self) -> String {
        let own = self.make.links[self.index].is_none();
        let elements = ["pIsImplemented", "pIsAvailable", "pIsLocked"];
        let mut text = String::new();
        for (element, (_, suffix, there)) in elements.iter().zip(self.flags()) {
            if there && own {
                let _ = write!(text, "<{element}>{}{suffix}</{element}>", self.feature.name);
            }
        }
        text
    }

    /// Smallest and largest value and increment; a size's always depend on the sensor.
    fn bounds(&self) -> [Bound; 3] {
        let Feature { name, min, max, inc, .. } = self.feature;
        match name.as_str() {
            "Width" | "Height" | "OffsetX" | "OffsetY" => [Bound::Depends; 3],
            _ => [*min, *max, *inc],
        }
    }

    fn limits(&self, linked: bool) -> String {
        let range = rules::range(self.feature);
        let float = self.feature.kind == Kind::Float;
        let constant = |value: f64| {
            if float { format!("{value:?}") } else { format!("{}", value as i64) }
        };
        let mut text = String::new();
        let [min, max, inc] = self.bounds();
        for (bound, element, suffix, value) in [
            (min, "Min", "_SimMin", range.min),
            (max, "Max", "_SimMax", range.max),
            (inc, "Inc", "_SimInc", range.inc),
        ] {
            let _ = match bound {
                _ if float && element == "Inc" => Ok(()),
                Bound::Absent => Ok(()),
                Bound::Depends if linked => write!(text, "<{element}>{}</{element}>", constant(value)),
                Bound::Depends => write!(text, "<p{element}>{}{suffix}</p{element}>", self.feature.name),
                Bound::Fixed(value) => write!(text, "<{element}>{}</{element}>", constant(value)),
            };
        }
        text
    }

    fn unit(&self) -> String {
        self.feature
            .unit
            .as_ref()
            .map_or_else(String::new, |unit| format!("<Unit>{}</Unit>", plain_text(unit)))
    }

    fn selected(&self) -> String {
        let names = self.make.declared.iter().zip(&self.make.table.features);
        let of = names.filter(|(selectors, _)| selectors.contains(&self.index));
        of.map(|(_, feature)| format!("<pSelected>{}</pSelected>", feature.name)).collect()
    }

    fn entries(&self, link: Option<Link>) -> String {
        let mut text = String::new();
        for (place, entry) in self.feature.entries.iter().enumerate() {
            let standard = link.and_then(|link| link.entries.iter().find(|(name, _)| name == entry));
            let code =
                standard.map_or_else(|| self.make.code(self.index, place), |(_, code)| i64::from(*code));
            let there = rules::entry_implemented(&self.make.table, self.feature, entry);
            let condition = if there { "" } else { "<pIsImplemented>NeverThere</pIsImplemented>" };
            let _ = write!(text, "<EnumEntry Name=\"{entry}\">{condition}<Value>{code}</Value></EnumEntry>");
        }
        text
    }

    fn text_register(&mut self, name: &str, link: Option<Link>, conditions: &str, access: Access) {
        let (address, length) = match link {
            Some(link) => (link.address, link.length),
            None => (places::value(self.index), places::length(Kind::String)),
        };
        self.put(&format!(
            "<StringReg Name=\"{name}\">{conditions}<Address>{address:#x}</Address><Length>{length}</Length>\
             <AccessMode>{}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable></StringReg>",
            access_text(access)
        ));
        if link.is_none() {
            self.said(false);
        }
    }

    fn register(&mut self, name: &str, address: u32, length: u32, form: Form) {
        let head = format!(
            "<Visibility>Invisible</Visibility><Address>{address:#x}</Address><Length>{length}</Length>\
             <AccessMode>{}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>",
            access_text(form.access)
        );
        let sign = if form.signed && length == 8 { "Signed" } else { "Unsigned" };
        let order = "<Endianess>BigEndian</Endianess>";
        self.put(&match form.bits {
            _ if form.float => format!("<FloatReg Name=\"{name}\">{head}{order}</FloatReg>"),
            Some((first, last)) => format!(
                "<MaskedIntReg Name=\"{name}\">{head}<LSB>{last}</LSB><MSB>{first}</MSB><Sign>Unsigned</Sign>{order}</MaskedIntReg>"
            ),
            None => format!("<IntReg Name=\"{name}\">{head}<Sign>{sign}</Sign>{order}</IntReg>"),
        });
    }
}

/// The form of a feature's register in the description.
struct Form {
    access: Access,
    bits: Option<(u8, u8)>,
    float: bool,
    signed: bool,
}
