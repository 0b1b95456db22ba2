// SPDX-License-Identifier: MIT OR Apache-2.0
//! What happens to a session while it runs: the HSU's reports, lost and returning devices, the recorder's word.

use super::camera_keeper::{CameraReport, Report};
use super::event_kind::EventKind;
use super::node_thread::{Node, hsu_session};
use super::silence::{Notice, SILENT_TRIGGERS};
use super::state_machine::Event;
use crate::acquire::recorder::{RecorderCommand, RecorderEvent};
use crate::base::ids::TriggerIndex;
use crate::base::{Exit, Fault};
use crate::config::OnLoss;
use crate::control::request::Phase;
use crate::control::status::Outcome;
use crate::hsu::{Fault as HsuFault, Hsu, HsuEvent, LinkLoss, TriggerFlags, trigger_index};
use crate::record::{NodeEvent, TriggerRecord};
use crossbeam_channel::never;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

impl Node {
    pub(crate) fn hsu_event(&mut self, event: HsuEvent) {
        let ours = self.machine.request().map(|request| hsu_session(request.session_id));
        match event {
            HsuEvent::Trigger { session, trigger } if Some(session) == ours => {
                self.in_session(|session| session.next_trigger = trigger.number.saturating_add(1));
                let Some(host_time_ns) = self.session.as_ref().map(|session| session.clock.now()) else {
                    return;
                };
                let Some(index) = trigger_index(&trigger) else {
                    let command = RecorderCommand::WarmUp {
                        number: trigger.number,
                        hsu_time_ns: trigger.time_ns,
                        late: trigger.flags.contains(TriggerFlags::LATE),
                        host_time_ns,
                    };
                    return self.in_session(|session| session.send(command));
                };
                let record = TriggerRecord {
                    index,
                    hsu_time_ns: trigger.time_ns,
                    flags: u32::from(trigger.flags.0),
                    host_time_ns,
                };
                self.in_session(|session| session.send(RecorderCommand::Trigger(record)));
                self.take(Event::Trigger);
                self.check_silence(index.0);
            }
            HsuEvent::TriggersMissing { session, first, count } if Some(session) == ours => {
                let message = format!("the times of {count} triggers from {first} on are lost");
                self.note(EventKind::TriggersMissing, None, message);
            }
            HsuEvent::Done { session, emitted, .. } if Some(session) == ours => {
                self.take(Event::TrainDone { emitted })
            }
            HsuEvent::Fault { session, fault } if Some(session) == ours => {
                let message = format!("the HSU reports: {fault}");
                self.note(EventKind::HsuFault, None, message.as_str());
                // The other node looks for its link; the train goes on, and so do we.
                let other_link = matches!(fault, HsuFault::LinkSilent { .. });
                let running = self.machine.train_runs();
                if other_link && running && self.config.on_link_lost == OnLoss::Continue {
                    return;
                }
                self.take(Event::Failed(Fault::new(Exit::Device, message)));
            }
            HsuEvent::LinkLost(LinkLoss::Restarted) => self.hsu_gone("it was restarted".to_owned()),
            // A cable that was pulled looks like a unit that is silent; both take a new connection.
            HsuEvent::LinkLost(LinkLoss::Silent) => self.link_lost("it does not answer".to_owned()),
            HsuEvent::LinkLost(LinkLoss::Broken(cause)) => self.link_lost(cause),
            _ => {}
        }
    }

    /// The HSU cannot be used in this session any more.
    pub(crate) fn hsu_gone(&mut self, reason: String) {
        let message = lost_link_text(&reason);
        self.devices.drop_hsu(message.clone());
        self.note(EventKind::HsuLost, None, message.as_str());
        self.take(Event::Failed(Fault::new(Exit::Device, message)));
    }

    /// The link is lost, not the HSU: as configured the session goes on, and the link is restored.
    pub(crate) fn link_lost(&mut self, reason: String) {
        let goes_on = self.machine.train_runs() && self.config.on_link_lost == OnLoss::Continue;
        if !goes_on {
            return self.hsu_gone(reason);
        }
        let message = lost_link_text(&reason);
        self.note(EventKind::HsuLinkLost, None, message.as_str());
        self.devices.drop_hsu(message);
        self.in_session(|session| {
            session.link_lost.get_or_insert_with(Instant::now);
            if let Some(keeper) = &session.link_keeper {
                keeper.reconnect(session.next_trigger);
            }
        });
        self.take(Event::LinkLost);
    }

    /// The link is back, with a new connection.
    pub(crate) fn link_back(&mut self, hsu: Arc<Hsu>) {
        self.devices.take_hsu(hsu);
        let message = "the HSU answers again; triggers fired meanwhile are requested";
        self.note(EventKind::HsuLinkBack, None, message);
        self.in_session(|session| {
            if let Some(lost) = session.link_lost.take() {
                let seconds = lost.elapsed().as_secs_f64();
                let text = format!("the line to the HSU was lost for {seconds:.1} s, and is back");
                session.notice("the line to the HSU", Some(text));
            }
        });
        self.take(Event::LinkBack);
    }

    /// Checks, trigger by trigger, which cameras send.
    pub(crate) fn check_silence(&mut self, trigger: u64) {
        let Some(session) = &mut self.session else { return };
        let period = Duration::from_secs_f64(1.0 / self.config.rig.trigger_rate_hz);
        let since = session.last_trigger.replace(Instant::now()).map(|last| last.elapsed());
        if since.is_some_and(|since| since < period / 2) {
            return session.silence.pass_over();
        }
        let heard = session.progress.activity.iter().map(|n| n.load(Ordering::Relaxed));
        for notice in session.silence.on_trigger(trigger, heard) {
            let (camera, kind, at, message) = match notice {
                Notice::Silent { camera, since } => {
                    if let Some(attendant) = session.attendants.get(camera) {
                        attendant.probe();
                    }
                    let message = format!("the camera sent nothing for {SILENT_TRIGGERS} triggers");
                    (camera, EventKind::CameraSilent, since, message)
                }
                Notice::HeardAgain { camera, at } => {
                    (camera, EventKind::CameraHeardAgain, at, "the camera sends again".to_owned())
                }
            };
            let id = session.cameras.get(camera).map(|camera| camera.id.clone());
            let trigger = Some(TriggerIndex(at));
            session.warn(NodeEvent { trigger, ..session.event(kind, id, message) });
        }
    }

    /// An attendant lost its camera, or has it back; or there is something that the operator must know.
    pub(crate) fn attendant_reports(&mut self, report: Report) {
        let Some(session) = &mut self.session else { return };
        let (camera, report) = match report {
            Report::Camera(camera, report) => (camera, report),
            Report::Notice(about, text) => {
                if let Some(text) = &text {
                    tracing::warn!(about, "{text}");
                }
                return session.notice(about, text);
            }
        };
        let Some(id) = session.cameras.get(camera).map(|camera| camera.id.clone()) else { return };
        let problem = match report {
            CameraReport::Lost(reason) => {
                let message = format!("camera {id} is lost: {reason}");
                self.devices.set_problem(camera, Some(message.clone()));
                self.note(EventKind::CameraLost, Some(id), message.as_str());
                let fatal = match self.machine.phase() {
                    Phase::Preparing | Phase::Ready => true,
                    Phase::Holding | Phase::Running => self.config.on_camera_lost == OnLoss::Abort,
                    Phase::Idle | Phase::Draining | Phase::Closing => false,
                };
                if fatal {
                    self.take(Event::Failed(Fault::new(Exit::Device, message)));
                }
                return;
            }
            CameraReport::Owned(reason) => Some(format!("camera {id}: {reason}")),
            CameraReport::Back => None,
        };
        tracing::warn!(camera = %id, "{}", problem.as_deref().unwrap_or("the camera is back"));
        self.devices.set_problem(camera, problem);
    }

    pub(crate) fn recorder_event(&mut self, event: RecorderEvent) {
        match event {
            RecorderEvent::Drained => self.take(Event::Drained),
            RecorderEvent::RingFull { why } => {
                let why = why.unwrap_or_else(|| "the disk could not keep up".to_owned());
                let message = format!("{why} and the ring is full; the session was stopped, as configured");
                self.note(EventKind::RingFull, None, message.as_str());
                self.take(Event::Failed(Fault::new(Exit::DataLoss, message)));
            }
            RecorderEvent::Doubtful { camera } => {
                let session = self.session.as_ref();
                if let Some(attendant) = session.and_then(|session| session.attendants.get(camera)) {
                    attendant.read_clock();
                }
            }
            RecorderEvent::Place { camera, unknown } => self.place(camera, unknown),
            RecorderEvent::Failed(fault) => self.take(Event::Failed(fault)),
            RecorderEvent::Closed(verdict) => {
                self.in_session(|session| {
                    session.outcome = Some(match verdict {
                        Ok(verdict) => {
                            tracing::info!("session {}: {verdict}", session.request.name);
                            Outcome::Recorded(serde_json::to_value(&verdict).unwrap_or_default())
                        }
                        Err(fault) => Outcome::Failed(fault),
                    });
                    session.end_recorder();
                });
                self.release_held_memory();
                self.take(Event::Closed);
            }
        }
    }

    /// Behind the warm-up: whether a camera's place in the train is known. Where it is not, its frames are lost as
    /// those of a camera that is away, and the session ends if it ends for one of these.
    fn place(&mut self, camera: usize, unknown: Option<String>) {
        let Some(session) = &mut self.session else { return };
        let Some(id) = session.cameras.get(camera).map(|camera| camera.id.clone()) else { return };
        let about = format!("place of {id}");
        let Some(why) = unknown else {
            session.notice(&about, None);
            let message = "which triggers its frames are of is known from here on";
            return self.note(EventKind::PlaceFound, Some(id), message);
        };
        let message = format!("camera {id}: {why}");
        session.notice(&about, Some(message.clone()));
        if self.machine.train_runs() && self.config.on_camera_lost == OnLoss::Abort {
            self.take(Event::Failed(Fault::new(Exit::Device, message)));
        }
    }

    /// The recorder's thread ended without a report: it panicked. The session cannot be finished.
    pub(crate) fn recorder_gone(&mut self) {
        self.in_session(|session| {
            session.from_recorder = never();
            let message =
                "the recorder stopped unexpectedly; what was written can be read with `fourdbody verify`";
            session.outcome.get_or_insert(Outcome::Failed(Fault::new(Exit::Failure, message)));
        });
        self.take(Event::Failed(Fault::new(Exit::Failure, "the recorder stopped unexpectedly")));
        self.take(Event::Drained);
        self.take(Event::Closed);
    }
}

fn lost_link_text(reason: &str) -> String {
    format!("the link to the HSU is lost ({reason}); check the serial cable and the HSU's power")
}
