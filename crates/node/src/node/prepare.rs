// SPDX-License-Identifier: MIT OR Apache-2.0
//! The steps of preparation that touch devices and disk, and what undoes them.

use super::camera_keeper::{Report, counters_text};
use super::devices::PreparedCamera;
use super::event_kind::EventKind;
use super::hold::held_sets;
use super::hsu_keeper::{HsuKeeper, LinkSetup};
use super::node_thread::{Node, hsu_session};
use crate::acquire::dry_run::DryRun;
use crate::acquire::receiver::{Arrival, ReceiverSetup};
use crate::acquire::recorder::{Channels, LaneSetup, Recorder, RecorderCommand, RecorderOptions};
use crate::base::ids::SessionName;
use crate::base::{Exit, Fault};
use crate::camera::AppliedSetting;
use crate::config::FeatureSetting;
use crate::matcher::{Matcher, Start};
use crate::record::{
    CameraHeader, ClockSample, HsuIdentity, RecordError, Recording, RecordingHeader, WriterOptions,
};
use crossbeam_channel::{bounded, unbounded};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

impl Node {
    pub(crate) fn create_recording(&mut self) -> Result<(), Fault> {
        let Some(session) = &mut self.session else { return Ok(()) };
        let read_back = |setting: &AppliedSetting| FeatureSetting {
            feature: setting.feature.clone(),
            value: setting.actual.clone(),
        };
        let camera = |camera: &PreparedCamera| CameraHeader {
            id: camera.id.clone(),
            width: pixels(camera.contract.size.0),
            height: pixels(camera.contract.size.1),
            device: [&camera.identity.vendor, &camera.identity.model, &camera.identity.serial]
                .map(String::as_str)
                .join(" "),
            pixel_format: camera.contract.pixel.name().to_owned(),
            settings: camera.settings.iter().map(read_back).collect(),
            state: camera.state.clone(),
        };
        let request = &session.request;
        let header = RecordingHeader {
            session: SessionName(request.name.clone()),
            session_id: format!("{:016x}", request.session_id),
            node: self.config.node.clone(),
            rig_text: self.config.rig_text.clone(),
            cameras: session.cameras.iter().map(camera).collect(),
            hsu: self.devices.hsu().map(|hsu| HsuIdentity {
                uid: hsu.unique_id(),
                firmware: hsu.identity().firmware.map(|n| n.to_string()).join("."),
                protocol: u32::from(hsu.welcome().agreed),
            }),
            expected_triggers: (request.triggers > 0).then_some(request.triggers),
            trigger_rate_hz: self.config.rig.trigger_rate_hz,
            host_clock: "CLOCK_REALTIME".to_owned(),
            created_ns: session.clock.now(),
            software: concat!("fourdbody ", env!("CARGO_PKG_VERSION")).to_owned(),
            subject: request.subject.clone(),
            note: request.note.clone(),
        };
        let options = WriterOptions {
            segment_bytes: self.config.segment_bytes,
            reserve_bytes: self.config.reserve_bytes,
            ..WriterOptions::default()
        };
        if request.dry_run {
            session.destination = Some(Box::new(DryRun::new(header)));
            return Ok(());
        }
        let mut recording = Recording::create(&session.dir, header, options).map_err(|error| {
            remove_if_empty(&session.dir);
            let exit = if matches!(error, RecordError::Exists { .. }) { Exit::Usage } else { Exit::Failure };
            Fault::new(exit, error)
        })?;
        let absent = self.config.rig.nodes().into_iter().filter(|node| !request.nodes.contains(node));
        for node in absent {
            let event = session.event(EventKind::NodeNotAsked, None, node.to_string());
            recording.event(&event).map_err(|error| Fault::new(Exit::Failure, error))?;
        }
        self.telemetry.recording(recording.progress());
        session.destination = Some(Box::new(recording));
        Ok(())
    }

    /// Relates the clocks, starts the recorder, then the streams and the attendants.
    pub(crate) fn start_streams(&mut self) -> Result<(), Fault> {
        let Some(session) = &mut self.session else { return Ok(()) };
        let Some(destination) = session.destination.take() else { return Ok(()) };
        let samples = self.devices.clock_burst(&session.clock);
        if let Some(action) = self.devices.unit().action() {
            action.tally.begin();
        }
        let period_ns = (1e9 / self.config.rig.trigger_rate_hz) as u64;
        let start = Start {
            period_ns,
            warm_up: self.config.rig.warm_up_triggers,
            hsu_minus_host_ns: hsu_minus_host_ns(&samples),
        };
        let lane = |camera: &PreparedCamera| LaneSetup {
            id: camera.id.clone(),
            width: pixels(camera.contract.size.0),
            height: pixels(camera.contract.size.1),
            matcher: Matcher::new(start),
        };
        let lanes: Vec<LaneSetup> = session.cameras.iter().map(lane).collect();
        let cameras = lanes.len();
        let (arrivals_in, arrivals) = bounded::<Arrival>(self.config.buffers_per_camera * cameras.max(1));
        let (to_recorder, commands) = unbounded();
        let (events, from_recorder) = unbounded();
        let thread_error =
            |e: std::io::Error| Fault::new(Exit::Failure, format!("cannot start a thread: {e}"));
        let progress = Arc::clone(&session.progress);
        let blocks = self.config.buffers_per_camera;
        let options = RecorderOptions {
            held_sets: held_sets(&session.request, self.config.rig.trigger_rate_hz),
            ..RecorderOptions::new(period_ns, blocks, self.config.when_full)
        };
        let taps = self.taps.clone();
        let recorder = Recorder::start(
            destination,
            taps,
            lanes,
            options,
            progress,
            Channels { arrivals, commands, events },
        )
        .map_err(thread_error)?;
        session.recorder = Some(recorder);
        session.from_recorder = from_recorder;
        session.to_recorder = Some(to_recorder.clone());
        samples.into_iter().for_each(|sample| session.send(RecorderCommand::Clock(sample)));
        for (camera, reason) in self.devices.without_clock() {
            let message = format!("its clock cannot be read, and its stamps have no witness: {reason}");
            session.warn(session.event(EventKind::NoCameraClock, Some(camera), message));
        }
        for camera in &session.cameras {
            for remark in &camera.told {
                session.warn(session.event(EventKind::CameraSetting, Some(camera.id.clone()), remark));
            }
        }
        let receivers: Vec<ReceiverSetup> = (0..cameras)
            .map(|camera| ReceiverSetup {
                camera,
                stream: 0,
                recorder: arrivals_in.clone(),
                progress: Arc::clone(&session.progress),
                clock: session.clock,
                patience: Duration::from_nanos(period_ns).max(Duration::from_millis(1)),
            })
            .collect();
        let started = self.devices.start_streams(
            &receivers,
            blocks + options.held_sets,
            &to_recorder,
            &session.reports_in,
        );
        session.attendants = started.inspect_err(|_| session.end_recorder())?;
        if let Some(hsu) = self.devices.hsu() {
            let setup = LinkSetup {
                hsu: Arc::clone(hsu),
                unit: self.devices.unit().clone(),
                node: self.config.node.clone(),
                session: hsu_session(session.request.session_id),
                clock: session.clock,
                to_recorder,
                reports: session.reports_in.clone(),
                back: session.links_in.clone(),
            };
            session.link_keeper = HsuKeeper::start(setup).map(Some).map_err(thread_error)?;
        }
        Ok(())
    }

    pub(crate) fn stop_streams(&mut self) {
        let Some(session) = &mut self.session else { return };
        if let Some(keeper) = session.link_keeper.take() {
            keeper.stop();
        }
        let attendants = std::mem::take(&mut session.attendants);
        let counters = self.devices.stop_streams(attendants);
        for (camera, counters) in session.cameras.iter().zip(counters) {
            let (id, text) = (Some(camera.id.clone()), counters_text(&counters));
            session.record(session.event(EventKind::StreamCounters, id, text));
        }
        for (camera, changed) in self.devices.changed_settings() {
            let changes: Vec<String> =
                changed.iter().map(|(name, was, is)| format!("{name} was {was}, is {is}")).collect();
            session.warn(session.event(EventKind::SettingChanged, Some(camera), changes.join("; ")));
        }
        self.record_actions();
        let Some(session) = &mut self.session else { return };
        // A camera that is probed is found lost 2.5 s later, while this thread waited for its attendant: the recording
        // must have that report before it is closed.
        let last_words: Vec<Report> = session.reports.try_iter().collect();
        last_words.into_iter().for_each(|report| self.attendant_reports(report));
        let dropped = self.devices.hsu().map_or(0, |hsu| hsu.dropped_events());
        if dropped > 0 {
            let text = format!("{dropped} events of the HSU gave way, unread, since its link was opened");
            self.note(EventKind::HsuEventsDropped, None, text);
        }
    }

    /// Removes what `create_recording` made: this session's own files, without a single trigger in them.
    pub(crate) fn discard_recording(&mut self) -> Result<(), Fault> {
        let Some(session) = &mut self.session else { return Ok(()) };
        session.end_recorder();
        session.destination = None;
        let (dir, is_written) = (session.dir.clone(), !session.request.dry_run);
        self.release_held_memory();
        if !is_written {
            return Ok(());
        }
        let removed = std::fs::remove_dir_all(&dir);
        remove_if_empty(&dir);
        removed.map_err(|e| Fault::new(Exit::Failure, format!("{}: cannot be removed: {e}", dir.display())))
    }
}

fn pixels(side: usize) -> u32 {
    u32::try_from(side).unwrap_or(u32::MAX)
}

/// The HSU's clock minus the host's, ns, by the exchange with the shortest round trip.
fn hsu_minus_host_ns(samples: &[ClockSample]) -> Option<i128> {
    let of_hsu = samples.iter().filter(|sample| sample.camera.is_none());
    let best = of_hsu.min_by_key(|sample| sample.host_receive_ns.saturating_sub(sample.host_send_ns))?;
    let host_ns = (i128::from(best.host_send_ns) + i128::from(best.host_receive_ns)) / 2;
    Some(i128::from(best.device_time_ns) - host_ns)
}

/// Removes a session's directory, unless the other node has recorded into it.
fn remove_if_empty(recording: &Path) {
    if let Some(session) = recording.parent() {
        // Not empty, or not there: both are as they should be.
        drop(std::fs::remove_dir(session));
    }
}
