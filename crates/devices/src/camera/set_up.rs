// SPDX-License-Identifier: MIT OR Apache-2.0
//! Brings a camera into a known state, sets it as the node file requests, and checks that it then sends what a session
//! records. All problems are reported, not only the first.

use super::description::{Access, Feature, list, nearest, plain};
use super::error::CameraError;
use super::features::{Features, answered, number_of, or_reason, value_of, value_text};
use super::packet_size;
use super::profile::{self, Amount, Must, Plan, Want, Wishes, Write};
use super::settings::{AppliedSetting, Change, SetUp, State, differs, matches};
use super::triggers::{TriggersOn, triggers_on};
use super::verify::verify;
use super::write_amount;
use crate::config::{FeatureSetting, FeatureValue};
use std::collections::BTreeMap;

/// Sets a camera up for a session.
///
/// # Errors
/// [`CameraError::SetUp`] with every problem; a lost camera ends the set-up at once.
pub fn set_up(camera: &dyn Features, wishes: &Wishes) -> Result<SetUp, CameraError> {
    let mut work = Work {
        camera,
        wishes,
        problems: Vec::new(),
        settings: Vec::new(),
        remarks: Vec::new(),
        set: BTreeMap::new(),
    };
    work.remarks.extend(load::known_state(camera, wishes, &mut work.problems)?);
    work.choose_triggers()?;
    let frame_trigger = profile::frame_trigger(camera).ok().flatten();
    work.select_trigger(frame_trigger.as_deref())?;
    let (musts, troubles) = profile::must_be(camera, wishes);
    work.problems.extend(troubles.iter().map(ToString::to_string));
    // Before the settings, because an automatic function may lock the feature that it drives; and again after them.
    for must in &musts {
        work.mend(must, true)?;
    }
    let plan = profile::resolve(camera, wishes);
    work.problems.extend(plan.troubles.iter().map(ToString::to_string));
    work.remarks.extend(plan.remarks.iter().cloned());
    if wishes.words.pixel.is_none_or(|pixel| pixel.step() == 1) {
        work.remarks.extend(colours(camera)?);
    }
    match or_reason(packet_size::set(camera, wishes.link.packet_bytes))? {
        Ok(remark) => work.remarks.extend(remark),
        Err(problem) => work.problems.push(problem),
    }
    work.plan(&plan)?;
    work.raw()?;
    work.select_trigger(frame_trigger.as_deref())?;
    for must in &musts {
        work.mend(must, false)?;
    }
    // Before the settings are read for the last time: reading a trigger means to select it, which may change others.
    let triggers = if wishes.triggered { triggers_on(camera)? } else { TriggersOn::default() };
    work.hold(&plan)?;
    work.still_as_set()?;
    work.finish(&plan, &musts, &triggers)
}

/// A set-up under way, with its findings so far.
struct Work<'a> {
    camera: &'a dyn Features,
    wishes: &'a Wishes,
    problems: Vec<String>,
    settings: Vec<AppliedSetting>,
    remarks: Vec<String>,
    /// The value of each feature that was set, as it was read back.
    set: BTreeMap<String, FeatureValue>,
}

impl Work<'_> {
    /// Cameras from before SFNC may have two models of triggers; the chosen model decides which triggers exist.
    fn choose_triggers(&self) -> Result<(), CameraError> {
        const MODEL: &str = "TriggerControlImplementation";
        if !self.wishes.left_to_settings("trigger_line")
            && let Some(model) = self.camera.feature(MODEL).filter(Feature::is_writable)
            && let Some(standard) = model.entry(&["Standard"])
        {
            answered(self.camera.set_text(MODEL, standard))?;
        }
        Ok(())
    }

    fn select_trigger(&self, entry: Option<&str>) -> Result<(), CameraError> {
        if let Some(entry) = entry
            && self.camera.feature("TriggerSelector").is_some_and(|selector| selector.is_writable())
            // On some cameras selecting a trigger also sets it, and would undo later settings.
            && answered(self.camera.text("TriggerSelector"))?.as_deref() != Some(entry)
        {
            answered(self.camera.set_text("TriggerSelector", entry))?;
        }
        Ok(())
    }

    /// Writes the plan. A feature that is not available yet may become so with a later setting: it is then written,
    /// behind the selector entry that was selected for it.
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
            let before = plan.writes[..place].iter().rev();
            let mut selected = before.take_while(|other| other.word == write.word);
            if let Some(select) = selected.find(|other| other.feature.ends_with("Selector")) {
                self.write(select)?;
            }
            match self.camera.is_available(&write.feature) {
                true => self.write(write)?,
                false => self.problems.push(format!(
                    "{} is not available as the camera is set: {}",
                    write.feature,
                    requester(write)
                )),
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
            // A raw setting that names the feature takes precedence.
            if raw.iter().any(|setting| setting.feature == write.feature) {
                continue;
            }
            let Some(set) = self.set.get(&write.feature).cloned() else { continue };
            if matches!(&write.amount, Amount::Value(_))
                && let Some(found) = answered(self.camera.read(&write.feature))?
                && differs(&set, &found)
                && let Err(problem) = or_reason(write_amount::write(self.camera, write))?
            {
                self.problems.push(problem);
            }
        }
        // The same for raw settings, unless they select triggers themselves.
        if raw.iter().any(|setting| setting.feature == "TriggerSelector") {
            return Ok(());
        }
        for (place, setting) in raw.iter().enumerate() {
            if setting.feature.starts_with("Trigger") && is_last(raw.iter(), place, setting) {
                self.check_raw(setting, true)?;
            }
        }
        Ok(())
    }

    /// Checks that a raw setting still holds, and where `again` sets it once more if it does not.
    fn check_raw(&mut self, setting: &FeatureSetting, again: bool) -> Result<(), CameraError> {
        let camera = self.camera;
        let other = || -> Result<_, CameraError> {
            Ok(answered(camera.read(&setting.feature))?.filter(|found| !matches(&setting.value, found)))
        };
        let mut found = other()?;
        if again && found.is_some() {
            answered(camera.write(&setting.feature, &setting.value))?;
            found = other()?;
        }
        self.problems.extend(found.map(|found| {
            format!(
                "feature {}: requested {}, the camera has {found} after all settings were made; correct `settings`",
                setting.feature, setting.value
            )
        }));
        Ok(())
    }

    /// Writes one value, and records what the camera has then.
    fn write(&mut self, write: &Write) -> Result<(), CameraError> {
        let feature = &write.feature;
        match or_reason(write_amount::write(self.camera, write))? {
            Err(_) if write.optional => {}
            Err(problem) => self.problems.push(problem),
            Ok(done) => {
                self.remarks.extend(done.remark);
                if !write.optional {
                    self.set.insert(feature.clone(), done.actual.clone());
                    let (requested, actual) = (done.requested, done.actual);
                    self.settings.push(AppliedSetting { feature: feature.clone(), requested, actual });
                }
            }
        }
        Ok(())
    }

    /// Sets the raw settings in their order and reads each back, then checks once more those that no later one repeats.
    fn raw(&mut self) -> Result<(), CameraError> {
        let mut set = Vec::new();
        for setting in &self.wishes.raw {
            if let Some(applied) = self.set_raw(setting)? {
                self.set.insert(setting.feature.clone(), applied.actual.clone());
                self.settings.push(applied);
                set.push(setting);
            }
        }
        for (place, setting) in set.iter().enumerate() {
            if setting.is_selector() {
                answered(self.camera.write(&setting.feature, &setting.value))?;
            } else if is_last(set.iter().copied(), place, setting) {
                self.check_raw(setting, false)?;
            }
        }
        Ok(())
    }

    fn set_raw(&mut self, setting: &FeatureSetting) -> Result<Option<AppliedSetting>, CameraError> {
        let FeatureSetting { feature, value } = setting;
        let problem = match self.camera.feature(feature) {
            None => format!(
                "feature {feature}: requested {value}, the camera has no such feature; nearest names: {}",
                list(&nearest(feature, &self.camera.names()))
            ),
            Some(Feature { entries, .. })
                if let FeatureValue::Text(text) = value
                    && !entries.is_empty()
                    && !entries.contains(text) =>
            {
                format!("`{text}` is not an entry of {feature}: {}; correct it in `settings`", list(&entries))
            }
            Some(_) => match or_reason(self.camera.write(feature, value))? {
                Err(why) => format!(
                    "{feature} cannot be set to {value}: the camera refuses it ({why}); correct it in `settings`"
                ),
                Ok(()) => {
                    // A write-only feature cannot be read back.
                    let actual = answered(self.camera.read(feature))?.unwrap_or_else(|| value.clone());
                    if matches(value, &actual) {
                        let requested = value.clone();
                        return Ok(Some(AppliedSetting { feature: feature.clone(), requested, actual }));
                    }
                    format!(
                        "feature {feature}: requested {value}, the camera has {actual}; correct it in `settings`"
                    )
                }
            },
        };
        self.problems.push(problem);
        Ok(None)
    }

    /// Gives a feature its required value, behind every entry of its selector. `early`: a refusal is no problem yet,
    /// because the second round tries again.
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
            && value_of(self.camera, switch)?.is_some_and(|value| is_off(&value))
        {
            return Ok(());
        }
        let Some(found) = answered(self.camera.read(feature))? else { return Ok(()) };
        let wanted = match &must.want {
            Want::Value(value) => value.clone(),
            Want::Least => {
                let least = self.camera.bounds_now(feature).min.unwrap_or(0.0);
                number_of(self.camera, feature, least.max(0.0))
            }
        };
        if !differs(&wanted, &found) {
            return Ok(());
        }
        let name = behind.map_or_else(|| feature.to_owned(), |entry| format!("{feature} of {entry}"));
        let mut why = "it can only be read".to_owned();
        if self.camera.feature(feature).is_some_and(|known| known.is_writable()) {
            why = match or_reason(self.camera.write(feature, &wanted))? {
                Ok(()) => "it stays".to_owned(),
                Err(reason) => format!("the camera refuses it: {reason}"),
            };
            if answered(self.camera.read(feature))?.is_some_and(|now| !differs(&wanted, &now)) {
                self.remarks.push(format!("{name} was {found} and is set to {wanted}"));
                return Ok(());
            }
        }
        let text = format!("{name} is {found}, expected {wanted}, and cannot be set ({why})");
        match (early, must.strict) {
            (true, _) => {}
            (false, true) => self.problems.push(format!(
                "{text}: switch off what drives it, by its own feature in `settings` or with the vendor's program"
            )),
            (false, false) => self.remarks.push(text),
        }
        Ok(())
    }

    /// Checks that no later setting has changed an earlier one.
    fn still_as_set(&mut self) -> Result<(), CameraError> {
        for (feature, value) in &self.set {
            let is_raw = self.wishes.raw.iter().any(|setting| setting.feature == *feature);
            if !is_raw
                && !feature.ends_with("Selector")
                && self.camera.feature(feature).is_none_or(|known| known.access != Access::Write)
                && let Some(found) = answered(self.camera.read(feature))?
                && differs(value, &found)
            {
                self.problems.push(format!(
                    "{feature} is {found} after all settings were made, it was set to {value}: find the setting that \
                     changes it"
                ));
            }
        }
        Ok(())
    }

    /// Whether a problem is about a feature that another problem already names.
    fn is_known(&self, problem: &str, plan: &Plan) -> bool {
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
                // The reason why a setting failed is more useful than the fact that the value is wrong.
                let unknown = problems.into_iter().filter(|problem| !self.is_known(problem, plan));
                let unknown: Vec<String> = unknown.collect();
                self.problems.extend(unknown);
                None
            }
            Err(error) => return Err(error),
        };
        let of_musts = musts.iter().filter(|must| must.strict && must.selector.is_none());
        let set = self.set.keys().chain(of_musts.map(|must| &must.feature));
        let watched = values_of(
            self.camera,
            set.filter(|feature| {
                self.camera.feature(feature).is_some_and(|known| known.access != Access::Write)
            }),
        )?;
        match contract {
            Some(contract) if self.problems.is_empty() => {
                self.remarks.extend(contract.loss());
                Ok(SetUp { contract, settings: self.settings, remarks: self.remarks, watched })
            }
            _ => Err(CameraError::SetUp { problems: self.problems }),
        }
    }
}

/// Whether no later raw setting names the same feature.
fn is_last<'a>(
    settings: impl Iterator<Item = &'a FeatureSetting>,
    place: usize,
    setting: &FeatureSetting,
) -> bool {
    settings.skip(place + 1).all(|later| later.feature != setting.feature)
}

/// The values of features that are available and readable, as text; selectors are left out.
fn values_of<'a>(
    camera: &dyn Features,
    names: impl Iterator<Item = &'a String>,
) -> Result<State, CameraError> {
    let mut state = State::new();
    for name in names.filter(|name| !name.ends_with("Selector")) {
        if let Some(value) = value_of(camera, name)? {
            state.insert(name.clone(), value_text(&value));
        }
    }
    Ok(state)
}

/// The remark about a colour sensor that sends grey.
fn colours(camera: &dyn Features) -> Result<Option<String>, CameraError> {
    const FILTER: &str = "PixelColorFilter";
    let filter = if camera.has(FILTER) { answered(camera.text(FILTER))? } else { None };
    let why = match filter {
        Some(filter) if plain(&filter) == "none" => return Ok(None),
        Some(filter) => format!("{FILTER} is {filter}"),
        None => match camera.entries("PixelFormat").iter().find(|format| format.starts_with("Bayer")) {
            Some(format) => format!("PixelFormat also has {format}"),
            None => return Ok(None),
        },
    };
    Ok(Some(format!(
        "the sensor sees colours ({why}): the camera makes grey of several pixels, in which fringes of one colour are \
         coarser and \
         darker; expected a grey sensor"
    )))
}

/// The part of a message that names the configuration key behind a write.
fn requester(write: &Write) -> String {
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

/// The watched features that have changed since the set-up.
pub fn changed(camera: &dyn Features, watched: &State) -> Result<Vec<Change>, CameraError> {
    let mut changed = Vec::new();
    for (feature, before) in watched {
        let now = answered(camera.read(feature))?
            .map_or_else(|| "not readable".to_owned(), |value| value_text(&value));
        if now != *before {
            changed.push((feature.clone(), before.clone(), now));
        }
    }
    Ok(changed)
}

mod load;

#[cfg(test)]
mod tests;
