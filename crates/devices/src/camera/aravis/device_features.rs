// SPDX-License-Identifier: MIT OR Apache-2.0
//! Features and registers of a camera that Aravis has opened.

use super::registers::holder;
use super::{AravisCamera, checked, message_of};
use crate::camera::description::{Access, Bounds, Description, Feature, Kind};
use crate::camera::error::CameraError;
use crate::camera::features::{Failed, Features};
use crate::config::FeatureValue;
use aravis::prelude::*;
use glib::prelude::{Cast, ObjectExt};
use std::collections::BTreeSet;

/// Most features that are listed; no camera has as many.
const FEATURES_MAX: usize = 5000;
/// Limits of floats beyond this mean that there is none.
const UNBOUNDED: f64 = 1e300;
/// Steps below this mean that there is none: Aravis then gives the least positive number.
const NO_STEP: f64 = 1e-12;

/// Whether the camera did not answer, as opposed to a refusal.
pub(super) fn is_silence(error: &glib::Error) -> bool {
    use aravis::DeviceError::{NotConnected, Timeout, TransferError};
    [Timeout, NotConnected, TransferError].iter().any(|kind| error.matches(*kind))
}

/// Whether the camera refused because another program controls it, or because the feature is locked.
fn is_refusal(error: &glib::Error) -> bool {
    use aravis::DeviceError::{NotController, ProtocolErrorAccessDenied};
    [NotController, ProtocolErrorAccessDenied].iter().any(|kind| error.matches(*kind))
}

impl AravisCamera {
    /// The meaning of an error while reading.
    fn failed(&self, error: &glib::Error) -> Failed {
        let detail = message_of(error);
        if is_silence(error) {
            Failed::Lost(CameraError::Link { doing: "reading its features", detail })
        } else if is_refusal(error) {
            Failed::Lost(CameraError::NotOurs { holder: holder(&self.device), detail })
        } else {
            Failed::Refused(detail)
        }
    }

    /// The meaning of an error while writing: a denied access may be a locked feature, which is no loss of control.
    pub(super) fn not_set(&self, error: &glib::Error) -> Failed {
        let detail = message_of(error);
        if is_silence(error) {
            return Failed::Lost(CameraError::Link { doing: "setting its features", detail });
        }
        // A camera that was restarted has no controller, and the next heartbeat will notice it.
        if is_refusal(error) && self.privilege() == Some(0) {
            return Failed::Lost(CameraError::NotOurs { holder: None, detail });
        }
        Failed::Refused(detail)
    }

    /// The text of a feature. Inner error: the value of an enumeration's register that matches none of its entries.
    fn entry(&self, feature: &str) -> Result<Result<String, String>, Failed> {
        let text = checked::string(&self.device, feature).map_err(|error| self.failed(&error))?;
        let Some(text) = text else {
            let node = self.node(feature).and_then(|node| node.downcast::<aravis::GcEnumeration>().ok());
            let value = node.and_then(|node| node.int_value().ok());
            let value = value.map_or_else(|| "a value".to_owned(), |value| value.to_string());
            return Ok(Err(format!("{value}, which none of its entries has")));
        };
        Ok(Ok(text))
    }

    /// Collects the names of the features below a category, each once.
    fn walk(&self, category: &str, seen: &mut BTreeSet<String>, names: &mut Vec<String>) {
        let node = |name: &str| self.device.feature(name)?.downcast::<aravis::GcCategory>().ok();
        let Some(category) = node(category) else { return };
        for name in checked::features_of(&category) {
            if names.len() >= FEATURES_MAX || !seen.insert(name.clone()) {
                continue;
            }
            match node(&name) {
                Some(_) => self.walk(&name, seen, names),
                None => names.push(name),
            }
        }
    }

    fn node(&self, feature: &str) -> Option<aravis::GcFeatureNode> {
        self.device.feature(feature)?.downcast().ok()
    }

    fn kind(&self, feature: &str) -> Result<Kind, Failed> {
        let node = self.node(feature).ok_or_else(|| Failed::Refused("it has no such feature".to_owned()))?;
        Ok(kind_of(&node))
    }
}

fn kind_of(node: &aravis::GcFeatureNode) -> Kind {
    // An enumeration and a boolean are integers, too, so the order counts.
    let kinds = [
        (node.is::<aravis::GcEnumeration>(), Kind::Enumeration),
        (node.is::<aravis::GcBoolean>(), Kind::Boolean),
        (node.is::<aravis::GcCommand>(), Kind::Command),
        (node.is::<aravis::GcFloat>(), Kind::Float),
        (node.is::<aravis::GcInteger>(), Kind::Integer),
        (node.is::<aravis::GcString>(), Kind::Text),
    ];
    kinds.into_iter().find(|(is_it, _)| *is_it).map_or(Kind::Other, |(_, kind)| kind)
}

/// The entries that the camera implements, whether they can be selected now or not.
fn entries_of(node: &aravis::GcFeatureNode) -> Vec<String> {
    let Some(node) = node.downcast_ref::<aravis::GcEnumeration>() else { return Vec::new() };
    let there = node.entries().into_iter().filter(|entry| entry.is_implemented().unwrap_or(true));
    there.filter_map(|entry| checked::name_of(&entry)).collect()
}

impl Description for AravisCamera {
    fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        self.walk("Root", &mut BTreeSet::new(), &mut names);
        names
    }

    fn feature(&self, name: &str) -> Option<Feature> {
        let node = self.node(name)?;
        if !node.is_implemented().unwrap_or(true) {
            return None;
        }
        Some(Feature {
            kind: kind_of(&node),
            access: match node.actual_access_mode() {
                aravis::GcAccessMode::Ro => Access::Read,
                aravis::GcAccessMode::Wo => Access::Write,
                _ => Access::ReadWrite,
            },
            unit: checked::unit_of(&node).filter(|unit| !unit.is_empty()),
            entries: entries_of(&node),
        })
    }
}

impl Features for AravisCamera {
    fn has(&self, feature: &str) -> bool {
        // A description may be that of a whole family of models.
        self.node(feature).is_some_and(|node| node.is_implemented().unwrap_or(true))
    }

    fn is_available(&self, feature: &str) -> bool {
        let Some(node) = self.node(feature) else { return false };
        node.is_implemented().unwrap_or(true) && node.is_available().unwrap_or(true)
    }

    fn read(&self, feature: &str) -> Result<FeatureValue, Failed> {
        let device = &self.device;
        let value = match self.kind(feature)? {
            Kind::Boolean => device.boolean_feature_value(feature).map(FeatureValue::Flag),
            Kind::Integer => device.integer_feature_value(feature).map(FeatureValue::Integer),
            Kind::Float => device.float_feature_value(feature).map(FeatureValue::Float),
            Kind::Enumeration => {
                return Ok(FeatureValue::Text(self.entry(feature)?.unwrap_or_else(|none| none)));
            }
            Kind::Text => {
                checked::string(device, feature).map(|text| FeatureValue::Text(text.unwrap_or_default()))
            }
            Kind::Command | Kind::Other => return Err(Failed::Refused("it has no value".to_owned())),
        };
        value.map_err(|error| self.failed(&error))
    }

    fn write(&self, feature: &str, value: &FeatureValue) -> Result<(), Failed> {
        use FeatureValue::{Flag, Float, Integer, Text};
        let device = &self.device;
        let set = match (value, self.kind(feature)?) {
            (_, Kind::Command) => device.execute_command(feature),
            (Flag(value), Kind::Boolean) => device.set_boolean_feature_value(feature, *value),
            (Flag(value), Kind::Integer) => device.set_integer_feature_value(feature, i64::from(*value)),
            (Integer(value), Kind::Float) => device.set_float_feature_value(feature, *value as f64),
            (Integer(value), Kind::Integer | Kind::Enumeration) => {
                device.set_integer_feature_value(feature, *value)
            }
            (Float(value), Kind::Float) => device.set_float_feature_value(feature, *value),
            (Float(value), Kind::Integer) if value.fract() == 0.0 => {
                device.set_integer_feature_value(feature, *value as i64)
            }
            (Text(value), Kind::Enumeration | Kind::Text) => device.set_string_feature_value(feature, value),
            _ => return Err(Failed::Refused(format!("{value} is no value of its kind"))),
        };
        set.map_err(|error| self.not_set(&error))
    }

    fn bounds_now(&self, feature: &str) -> Bounds {
        let device = &self.device;
        let (limits, step) = match self.kind(feature) {
            Ok(Kind::Float) => {
                let finite = |limit: f64| (limit.abs() < UNBOUNDED).then_some(limit);
                let step = device.float_feature_increment(feature).ok().filter(|step| *step > NO_STEP);
                (checked::float_bounds(device, feature).map(|(min, max)| (finite(min), finite(max))), step)
            }
            Ok(Kind::Integer) => {
                let stated = |limit: i64| (limit != i64::MIN && limit != i64::MAX).then_some(limit as f64);
                let step = device.integer_feature_increment(feature).ok().map(|step| step as f64);
                (checked::integer_bounds(device, feature).map(|(min, max)| (stated(min), stated(max))), step)
            }
            _ => return Bounds::default(),
        };
        let (min, max) = limits.unwrap_or_default();
        Bounds { min, max, step }
    }

    fn integer(&self, feature: &str) -> Result<i64, Failed> {
        self.device.integer_feature_value(feature).map_err(|e| self.failed(&e))
    }

    fn text(&self, feature: &str) -> Result<String, Failed> {
        self.entry(feature)?.map_err(Failed::Nonsense)
    }

    fn execute(&self, feature: &str) -> Result<(), Failed> {
        self.device.execute_command(feature).map_err(|e| self.failed(&e))
    }

    fn is_done(&self, command: &str) -> Option<bool> {
        // GenICam: a command is done when its register has another value than the one that started it.
        let node = self.device.feature(command)?;
        let (mut register, mut started) = (None, None);
        let mut child = node.first_child();
        while let Some(property) = child {
            let name = checked::tag_of(&property).unwrap_or_default();
            if let Some(property) = property.downcast_ref::<aravis::GcPropertyNode>() {
                match name.as_str() {
                    "pValue" => register = property.linked_node(),
                    "CommandValue" | "pCommandValue" => started = property.int64().ok(),
                    _ => {}
                }
            }
            child = property.next_sibling();
        }
        // Some registers can be read although the description calls them write-only.
        let value = register?.dynamic_cast_ref::<aravis::GcInteger>()?.value().ok()?;
        Some(value != started?)
    }

    fn entries(&self, feature: &str) -> Vec<String> {
        if !self.has(feature) {
            return Vec::new();
        }
        checked::entries_now(&self.device, feature).unwrap_or_default()
    }

    fn has_registers(&self) -> bool {
        self.device.is::<aravis::GvDevice>()
    }

    fn register(&self, address: u64) -> Result<u32, Failed> {
        checked::register(&self.device, address).map_err(|e| self.failed(&e))
    }

    fn set_register(&self, address: u64, value: u32) -> Result<(), Failed> {
        self.device.write_register(address, value).map(drop).map_err(|e| self.failed(&e))
    }
}
