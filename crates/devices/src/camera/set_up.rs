// SPDX-License-Identifier: MIT OR Apache-2.0
//! A camera is brought into a known state, set as the node file says, and asked whether it then is as a session needs it.
//! Every problem is found, not the first alone.

use super::CameraError;
use super::description::{Access, Feature, list, nearest, plain};
use super::features::{Failed, Features, answered, value_text};
use super::packet_size;
use super::profile::{self, Amount, Must, Plan, Want, Wishes, Write};
use super::settings::{AppliedSetting, SetUp, matches};
use super::state::{Change, State};
use super::triggers::{TriggersOn, triggers_on};
use super::verify::verify;
use super::write_amount::{self, differs};
use crate::config::{FeatureSetting, FeatureValue};
use std::collections::BTreeMap;

/// Sets a camera up.
///
/// # Errors
/// [`CameraError::SetUp`] with every problem; what ends communication ends it at once.
pub fn set_up(camera: &dyn Features, wishes: &Wishes) -> Result<SetUp, CameraError> {
    let mut work = Work {
        camera,
        wishes,
        problems: Vec::new(),
        settings: Vec::new(),
        told: Vec::new(),
        set: BTreeMap::new(),
    };
    work.told.extend(load::known_state(camera, wishes, &mut work.problems)?);
    work.choose_triggers()?;
    let frame_trigger = profile::frame_trigger(camera).ok().flatten();
    work.select_trigger(frame_trigger.as_deref())?;
    let (musts, troubles) = profile::must_be(camera, wishes);
    work.problems.extend(troubles.iter().map(ToString::to_string));
    // Before the settings, because an automatic function may lock what it drives; and after them.
    for must in &musts {
        work.mend(must, true)?;
    }
    let plan = profile::resolve(camera, wishes);
    work.problems.extend(plan.troubles.iter().map(ToString::to_string));
    work.told.extend(plan.told.iter().cloned());
    if wishes.words.pixel.is_none_or(|pixel| pixel.step() == 1) {
        work.told.extend(colours(camera)?);
    }
    match packet_size::set(camera, wishes.link.packet_bytes)? {
        Ok(told) => work.told.extend(told),
        Err(problem) => work.problems.push(problem),
    }
    work.plan(&plan)?;
    work.raw()?;
    work.select_trigger(frame_trigger.as_deref())?;
    for must in &musts {
        work.mend(must, false)?;
    }
    // Asked before what was set is read for the last time: to look at a trigger one must select it, which may change others.
    let triggers = if wishes.triggered { triggers_on(camera)? } else { TriggersOn::default() };
    work.hold(&plan)?;
    work.still_as_set()?;
    work.finish(&plan, &musts, &triggers)
}

struct Work<'a> {
    camera: &'a dyn Features,
    wishes: &'a Wishes,
    problems: Vec<String>,
    settings: Vec<AppliedSetting>,
    told: Vec<String>,
    /// What each word has set, as it was read back.
    set: BTreeMap<String, FeatureValue>,
}

/// How a value that was refused is told.
fn refused(feature: &str, value: &str, why: &str) -> String {
    format!("{feature} cannot be set to {value}: the camera refuses it ({why})")
}

impl Work<'_> {
    /// Before SFNC one model of triggers stood beside another, and which of them is chosen says which triggers there are.
    fn choose_triggers(&self) -> Result<(), CameraError> {
        const MODEL: &str = "TriggerControlImplementation";
        if self.wishes.left_to_settings("trigger_line") {
            return Ok(());
        }
        if let Some(model) = self.camera.feature(MODEL).filter(Feature::is_writable)
            && let Some(standard) = model.entry(&["Standard"])
        {
            answered(self.camera.set_text(MODEL, standard))?;
        }
        Ok(())
    }

    fn select_trigger(&self, entry: Option<&str>) -> Result<(), CameraError> {
        if let Some(entry) = entry
            && self.camera.feature("TriggerSelector").is_some_and(|selector| selector.is_writable())
            // On some cameras to select is to set, and would undo what was set since.
            && answered(self.camera.text("TriggerSelector"))?.as_deref() != Some(entry)
        {
            answered(self.camera.set_text("TriggerSelector", entry))?;
        }
        Ok(())
    }

    /// Does what the words ask for. What is not there yet may come with what is set after it, and is set then, behind the
    /// entry that was selected for it.
    fn plan(&mut self, plan: &Plan) -> Result<(), CameraError> {
        let mut later = Vec::new();
        for (place, write) in plan.writes.iter().enumerate() {
            match self.camera.is_available(&write.feature) {
                true => self.write(write)?,
                false if write.optional => {}
                false => later.push((place, write)),
            }
        }
        for (place, write) in later {
            let feature = write.feature.as_str();
            let before = plan.writes[..place].iter().rev();
            let selected = before.take_while(|other| other.word == write.word);
            for select in selected.filter(|other| other.feature.ends_with("Selector")).take(1) {
                self.write(select)?;
            }
            match self.camera.is_available(feature) {
                true => self.write(write)?,
                false => {
                    self.problems
                        .push(format!("{feature} is not available as the camera is set: {}", of(write)));
                }
            }
        }
        Ok(())
    }

    /// Sets again what was lost when other triggers were selected.
    fn hold(&mut self, plan: &Plan) -> Result<(), CameraError> {
        let raw = &self.wishes.raw;
        let last = plan.writes.iter().rposition(|write| write.feature == "TriggerSelector");
        let of_trigger = last.map_or(&[][..], |last| &plan.writes[last + 1..]);
        for write in of_trigger.iter().filter(|write| !write.optional) {
            // What a raw setting has changed since is its own.
            if raw.iter().any(|setting| setting.feature == write.feature) {
                continue;
            }
            let Some(set) = self.set.get(&write.feature).cloned() else { continue };
            if matches!(&write.amount, Amount::Value(_))
                && let Some(found) = answered(self.camera.read(&write.feature))?
                && differs(&set, &found)
                && let Err(problem) = write_amount::write(self.camera, write)?
            {
                self.problems.push(problem);
            }
        }
        // The same for raw settings, unless they select triggers themselves.
        if raw.iter().any(|setting| setting.feature == "TriggerSelector") {
            return Ok(());
        }
        for (place, setting) in raw.iter().enumerate() {
            let again = raw[place + 1..].iter().any(|later| later.feature == setting.feature);
            if setting.feature.starts_with("Trigger")
                && !again
                && let Some(found) = answered(self.camera.read(&setting.feature))?
                && !matches(setting, &found)
            {
                answered(self.camera.write(&setting.feature, &setting.value))?;
                if let Some(found) = answered(self.camera.read(&setting.feature))?
                    && !matches(setting, &found)
                {
                    self.problems.push(format!(
                        "feature {}: asked for {}, the camera has {found} after all settings were made; correct `settings`",
                        setting.feature, setting.value
                    ));
                }
            }
        }
        Ok(())
    }

    /// Does what a word asks for, and notes what came of it.
    fn write(&mut self, write: &Write) -> Result<(), CameraError> {
        let feature = write.feature.as_str();
        let done = write_amount::write(self.camera, write)?;
        match done {
            Err(_) if write.optional => {}
            Err(problem) => self.problems.push(problem),
            Ok(done) => {
                self.told.extend(done.told);
                if !write.optional {
                    self.set.insert(feature.to_owned(), done.actual.clone());
                    let (requested, actual) = (done.requested, done.actual);
                    self.settings.push(AppliedSetting { feature: feature.to_owned(), requested, actual });
                }
            }
        }
        Ok(())
    }

    /// Sets the raw settings in their order, reads each back, and once more what no later one names again.
    fn raw(&mut self) -> Result<(), CameraError> {
        let wishes = self.wishes;
        let mut set = Vec::new();
        for setting in &wishes.raw {
            if let Some(applied) = self.set_raw(setting)? {
                self.set.insert(setting.feature.clone(), applied.actual.clone());
                self.settings.push(applied);
                set.push(setting);
            }
        }
        for (i, setting) in set.iter().enumerate() {
            if setting.is_selector() {
                answered(self.camera.write(&setting.feature, &setting.value))?;
            } else if !set[i + 1..].iter().any(|later| later.feature == setting.feature)
                && let Some(found) = answered(self.camera.read(&setting.feature))?
                && !matches(setting, &found)
            {
                self.problems.push(format!(
                    "feature {}: asked for {}, the camera has {found} after all settings were made; correct `settings`",
                    setting.feature, setting.value
                ));
            }
        }
        Ok(())
    }

    fn set_raw(&mut self, setting: &FeatureSetting) -> Result<Option<AppliedSetting>, CameraError> {
        let FeatureSetting { feature, value } = setting;
        let Some(has) = self.camera.feature(feature) else {
            let near = nearest(feature, &self.camera.names());
            self.problems.push(format!(
                "feature {feature}: asked for {value}, the camera has no such feature; nearest names: {}",
                list(&near)
            ));
            return Ok(None);
        };
        if let FeatureValue::Text(text) = value
            && !has.entries.is_empty()
            && !has.entries.contains(text)
        {
            self.problems.push(format!(
                "`{text}` is not an entry of {feature}: {}; correct it in `settings`",
                list(&has.entries)
            ));
            return Ok(None);
        }
        match self.camera.write(feature, value) {
            Ok(()) => {}
            Err(Failed::Lost(error)) => return Err(error),
            Err(Failed::Refused(why) | Failed::Nonsense(why)) => {
                self.problems.push(format!(
                    "{}; correct it in `settings`",
                    refused(feature, &value.to_string(), &why)
                ));
                return Ok(None);
            }
        }
        let actual = match self.camera.read(feature) {
            Ok(actual) => actual,
            Err(Failed::Lost(error)) => return Err(error),
            // One that can only be written was written.
            Err(Failed::Refused(_) | Failed::Nonsense(_)) => value.clone(),
        };
        if !matches(setting, &actual) {
            self.problems.push(format!(
                "feature {feature}: asked for {value}, the camera has {actual}; correct it in `settings`"
            ));
            return Ok(None);
        }
        Ok(Some(AppliedSetting { feature: feature.clone(), requested: value.clone(), actual }))
    }

    /// Has what must be so be so, behind every entry of its selector. `early`: what refuses is asked again later.
    fn mend(&mut self, must: &Must, early: bool) -> Result<(), CameraError> {
        let selector = must.selector.filter(|selector| self.camera.has(selector));
        let entries = selector.map_or_else(Vec::new, |selector| self.camera.entries(selector));
        let Some(selector) = selector.filter(|_| entries.len() > 1) else {
            return self.mend_one(must, None, early);
        };
        let before = answered(self.camera.text(selector))?;
        for entry in entries {
            if answered(self.camera.set_text(selector, &entry))?.is_some() {
                self.mend_one(must, Some(&entry), early)?;
            }
        }
        if let Some(before) = before {
            answered(self.camera.set_text(selector, &before))?;
        }
        Ok(())
    }

    fn mend_one(&mut self, must: &Must, behind: Option<&str>, early: bool) -> Result<(), CameraError> {
        let feature = must.feature.as_str();
        if !self.camera.is_available(feature) {
            return Ok(());
        }
        if let Some(switch) = must.unless_off
            && self.camera.is_available(switch)
            && let Some(value) = answered(self.camera.read(switch))?
            && is_off(&value)
        {
            return Ok(());
        }
        // What cannot be read cannot be said to be wrong.
        let Some(found) = answered(self.camera.read(feature))? else { return Ok(()) };
        let wanted = match &must.want {
            Want::Value(value) => value.clone(),
            Want::Least => match self.camera.bounds_now(feature).min {
                Some(min) => number_like(&found, min.max(0.0)),
                None => number_like(&found, 0.0),
            },
        };
        if !differs(&wanted, &found) {
            return Ok(());
        }
        let name = behind.map_or_else(|| feature.to_owned(), |entry| format!("{feature} of {entry}"));
        let access = self.camera.feature(feature).map_or(Access::Read, |known| known.access);
        let mut why = "it can only be read".to_owned();
        if access != Access::Read {
            match self.camera.write(feature, &wanted) {
                Ok(()) => why = "it stays".to_owned(),
                Err(Failed::Lost(error)) => return Err(error),
                Err(Failed::Refused(reason) | Failed::Nonsense(reason)) => {
                    why = format!("the camera refuses it: {reason}")
                }
            }
            if let Some(now) = answered(self.camera.read(feature))?
                && !differs(&wanted, &now)
            {
                self.told.push(format!("{name} was {found} and is set to {wanted}"));
                return Ok(());
            }
        }
        let text = format!("{name} is {found}, expected {wanted}, and cannot be set ({why})");
        match (early, must.strict) {
            (true, _) => {}
            (false, true) => self.problems.push(format!(
                "{text}: switch off what drives it, by its own feature in `settings` or with the vendor's program"
            )),
            (false, false) => self.told.push(text),
        }
        Ok(())
    }

    /// What is set later may change what was set before.
    fn still_as_set(&mut self) -> Result<(), CameraError> {
        let named: Vec<&str> = self.wishes.raw.iter().map(|setting| setting.feature.as_str()).collect();
        for (feature, value) in &self.set {
            if named.contains(&feature.as_str()) || feature.ends_with("Selector") {
                continue;
            }
            if self.camera.feature(feature).is_some_and(|known| known.access == Access::Write) {
                continue;
            }
            if let Some(found) = answered(self.camera.read(feature))?
                && differs(value, &found)
            {
                self.problems.push(format!(
                    "{feature} is {found} after all settings were made, it was set to {value}: look what changes it"
                ));
            }
        }
        Ok(())
    }

    /// Whether a problem is about a feature of which there is one already.
    fn is_told(&self, problem: &str, plan: &Plan) -> bool {
        let words = |text: &str| -> Vec<String> {
            text.split([' ', ':', ',', ';', '`']).map(str::to_owned).collect()
        };
        let feature = words(problem).swap_remove(0);
        let trigger = |name: &str| name.starts_with("Trigger");
        self.problems.iter().any(|known| words(known).contains(&feature))
            || trigger(&feature) && plan.troubles.iter().any(|trouble| trigger(&trouble.feature))
    }

    fn finish(mut self, plan: &Plan, musts: &[Must], triggers: &TriggersOn) -> Result<SetUp, CameraError> {
        let contract = match verify(self.camera, self.wishes, plan.pixel_format.as_ref(), triggers) {
            Ok(contract) => Some(contract),
            Err(CameraError::SetUp { problems }) => {
                // The reason why something was not set says more than that it is not so.
                let unknown = problems.into_iter().filter(|problem| !self.is_told(problem, plan));
                let unknown: Vec<String> = unknown.collect();
                self.problems.extend(unknown);
                None
            }
            Err(error) => return Err(error),
        };
        let mut watched = State::new();
        let of_musts = musts.iter().filter(|must| must.strict && must.selector.is_none());
        let set = self.set.keys().map(String::as_str).chain(of_musts.map(|must| must.feature.as_str()));
        for feature in set.filter(|feature| !feature.ends_with("Selector")) {
            if self.camera.is_available(feature)
                && self.camera.feature(feature).is_some_and(|known| known.access != Access::Write)
                && let Some(value) = answered(self.camera.read(feature))?
            {
                watched.insert(feature.to_owned(), value_text(&value));
            }
        }
        match contract {
            Some(contract) if self.problems.is_empty() => {
                self.told.extend(contract.loss());
                Ok(SetUp { contract, settings: self.settings, told: self.told, watched })
            }
            _ => Err(CameraError::SetUp { problems: self.problems }),
        }
    }
}

/// What to say of a sensor that sees colours and sends grey.
fn colours(camera: &dyn Features) -> Result<Option<String>, CameraError> {
    const FILTER: &str = "PixelColorFilter";
    let filter = match camera.has(FILTER) {
        true => answered(camera.text(FILTER))?,
        false => None,
    };
    let formats = camera.entries("PixelFormat");
    let why = match filter {
        Some(filter) if plain(&filter) == "none" => return Ok(None),
        Some(filter) => format!("{FILTER} is {filter}"),
        None => match formats.iter().find(|format| format.starts_with("Bayer")) {
            Some(format) => format!("PixelFormat also has {format}"),
            None => return Ok(None),
        },
    };
    Ok(Some(format!(
        "the sensor sees colours ({why}): the camera makes grey of several pixels, in which fringes of one colour are coarser and \
         darker; expected a grey sensor"
    )))
}

/// What asked for a write.
fn of(write: &Write) -> String {
    match write.word {
        "" => "expected it to be set; set what it comes with in `settings`".to_owned(),
        word => format!("{word} sets it; set what it comes with in `settings`"),
    }
}

fn is_off(value: &FeatureValue) -> bool {
    match value {
        FeatureValue::Flag(on) => !on,
        FeatureValue::Integer(value) => *value == 0,
        FeatureValue::Float(_) => false,
        FeatureValue::Text(text) => ["Off", "Disabled", "False"].contains(&text.as_str()),
    }
}

/// A number of the same kind as another value.
fn number_like(like: &FeatureValue, number: f64) -> FeatureValue {
    match like {
        FeatureValue::Integer(_) => FeatureValue::Integer(number.round() as i64),
        _ => FeatureValue::Float(number),
    }
}

/// What has changed of what was to stay as it is: name, then, now.
pub fn changed(camera: &dyn Features, watched: &State) -> Result<Vec<Change>, CameraError> {
    let mut changed = Vec::new();
    for (feature, before) in watched {
        let now = match answered(camera.read(feature))? {
            Some(value) => value_text(&value),
            None => "not readable".to_owned(),
        };
        if now != *before {
            changed.push((feature.clone(), before.clone(), now));
        }
    }
    Ok(changed)
}

mod load;

#[cfg(test)]
mod tests;
