// SPDX-License-Identifier: MIT OR Apache-2.0
//! What an operator sees of the cameras while they run: small pictures, and the figures by which exposure and focus
//! are set.
//!
//! A thread of low priority renders what the taps of the recorder leave ([`crate::acquire::preview`]), at most four
//! pictures a second and camera, and only while they are requested. It renders once for all clients.

mod exposure;
mod light;
mod picture;
pub mod quick_look;

pub use exposure::{Exposure, Peaks};
pub use light::{Light, LightGrades, measure};
pub use picture::upright_png;

use crate::acquire::preview::{Sample, Taps};
use crate::base::ids::CameraId;
use crate::control::interest::Interest;
use crate::host::realtime;
use crossbeam_channel::{Receiver, Sender, bounded};
use serde::Serialize;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

/// Least time between two pictures of a camera.
const PERIOD: Duration = Duration::from_millis(250);
/// Time between two looks for samples.
const POLL: Duration = Duration::from_millis(40);

/// One camera's newest picture, as PNG with its figures.
#[derive(Debug, Clone)]
pub struct Picture {
    pub number: u64,
    pub trigger: u64,
    /// When the frame arrived, host clock, ns.
    pub host_time_ns: u64,
    /// Upright, a quarter of the frame's size, PNG; saturated pixels are red.
    pub png: Vec<u8>,
    /// What the light is good for, to lie over it, where somebody has asked for that of late.
    pub light_png: Option<Vec<u8>>,
    /// A square with all its pixels, upright, where somebody has asked for that of late.
    pub detail_png: Option<Vec<u8>>,
    /// What its light is like.
    pub light: Light,
}

/// What a client wants of a camera's newest picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Part {
    /// The picture itself, a quarter of the frame.
    Whole,
    /// [`Picture::light_png`], to lie over the picture.
    Light,
    /// [`Picture::detail_png`] about this place: parts of the upright picture's width from the left, and of its height from
    /// the top, from 0 to 1.
    Detail([f32; 2]),
}

impl Picture {
    /// The PNG of a part; `None` where it has not been made yet.
    pub fn part(&self, part: Part) -> Option<&[u8]> {
        match part {
            Part::Whole => Some(&self.png),
            Part::Light => self.light_png.as_deref(),
            Part::Detail(_) => self.detail_png.as_deref(),
        }
    }
}

/// The description of a picture, without its pixels.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct PictureFacts {
    /// The name of the camera in the rig.
    #[schema(value_type = String)]
    pub camera: CameraId,
    /// See [`Picture::number`]; 0: there is none yet.
    pub number: u64,
    /// The index of the frame's trigger.
    pub trigger: u64,
    /// How long ago the frame arrived, s.
    pub age_s: f64,
    /// The light of the frame; none before the first picture.
    pub light: Option<Light>,
    /// The grades of that light.
    pub grades: Option<LightGrades>,
}

/// Renders the cameras' pictures on a thread of low priority.
#[derive(Clone)]
pub struct Previews {
    shared: Arc<Shared>,
    wake: Sender<()>,
}

struct Shared {
    taps: Arc<Taps>,
    requested: Vec<Interest>,
    light_requested: Vec<Interest>,
    detail_requested: Vec<Interest>,
    pictures: Vec<RwLock<Option<Arc<Picture>>>>,
}

impl Previews {
    /// Starts the thread; it ends with the last clone.
    pub fn start(taps: Arc<Taps>) -> std::io::Result<Self> {
        let cameras = taps.cameras().count();
        let shared = Arc::new(Shared {
            taps,
            requested: (0..cameras).map(|_| Interest::default()).collect(),
            light_requested: (0..cameras).map(|_| Interest::default()).collect(),
            detail_requested: (0..cameras).map(|_| Interest::default()).collect(),
            pictures: (0..cameras).map(|_| RwLock::default()).collect(),
        });
        let (wake, awake) = bounded(1);
        let seen = Arc::clone(&shared);
        std::thread::Builder::new().name("preview".to_owned()).spawn(move || {
            realtime::step_back();
            seen.run(&awake);
        })?;
        Ok(Self { shared, wake })
    }

    /// The newest picture of a camera, and the wish for the next one with this part.
    pub fn latest(&self, camera: &str, part: Part) -> Result<Option<Arc<Picture>>, UnknownCamera> {
        let place = self.shared.taps.cameras().position(|known| known.as_str() == camera);
        let place = place.ok_or_else(|| UnknownCamera {
            asked: camera.to_owned(),
            known: self.shared.taps.cameras().map(ToString::to_string).collect(),
        })?;
        match part {
            Part::Whole => {}
            Part::Light => self.shared.light_requested[place].note(),
            Part::Detail([right, down]) => {
                self.shared.detail_requested[place].note();
                // Upright pictures are frames turned clockwise.
                self.shared.taps.show_detail(place, Some([down, 1.0 - right]));
            }
        }
        Ok(self.look(place))
    }

    /// What is known of all cameras' pictures, and the wish for the next ones.
    pub fn facts(&self) -> Vec<PictureFacts> {
        let now_ns = crate::base::time::host_time_ns();
        let cameras = self.shared.taps.cameras().cloned().enumerate();
        let fact = |(place, camera): (usize, CameraId)| match self.look(place) {
            None => PictureFacts { camera, number: 0, trigger: 0, age_s: 0.0, light: None, grades: None },
            Some(picture) => PictureFacts {
                camera,
                number: picture.number,
                trigger: picture.trigger,
                age_s: now_ns.saturating_sub(picture.host_time_ns) as f64 / 1e9,
                light: Some(picture.light.clone()),
                grades: Some(picture.light.grades()),
            },
        };
        cameras.map(fact).collect()
    }

    fn look(&self, place: usize) -> Option<Arc<Picture>> {
        self.shared.requested.get(place)?.note();
        // A thread that is awake already needs no second call.
        let _ = self.wake.try_send(());
        self.shared.pictures.get(place)?.read().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// A camera that this node does not have.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no camera {asked:?} at this node; it has {}", known.join(", "))]
pub struct UnknownCamera {
    asked: String,
    known: Vec<String>,
}

impl Shared {
    fn run(&self, awake: &Receiver<()>) {
        let cameras = self.requested.len();
        let mut next: Vec<Instant> = vec![Instant::now(); cameras];
        let mut done: Vec<Option<Sample>> = vec![None; cameras];
        // Without requests it sleeps here; it ends when no client can send one any more.
        while awake.recv().is_ok() {
            while self.requested.iter().any(Interest::is_fresh) {
                for camera in (0..cameras).filter(|camera| self.requested[*camera].is_fresh()) {
                    if Instant::now() >= next[camera] {
                        if !self.detail_requested[camera].is_fresh() {
                            self.taps.show_detail(camera, None);
                        }
                        self.taps.ask(camera);
                        next[camera] = Instant::now() + PERIOD;
                    }
                    if let Some(sample) = self.taps.take(camera, &mut done[camera]) {
                        self.show(camera, &sample);
                        done[camera] = Some(sample);
                    }
                }
                std::thread::sleep(POLL);
            }
        }
    }

    fn show(&self, camera: usize, sample: &Sample) {
        let mut slot = self.pictures[camera].write().unwrap_or_else(PoisonError::into_inner);
        let number = slot.as_ref().map_or(0, |picture| picture.number) + 1;
        match picture::upright_png(sample) {
            Ok(png) => {
                let (trigger, host_time_ns) = (sample.trigger, sample.host_time_ns);
                let with_light = self.light_requested[camera].is_fresh();
                let light_png = with_light.then(|| picture::light_png(sample)).transpose().unwrap_or(None);
                let detail_png = picture::detail_png(sample).unwrap_or(None);
                let light = measure(sample);
                *slot = Some(Arc::new(Picture {
                    number,
                    trigger,
                    host_time_ns,
                    png,
                    light_png,
                    detail_png,
                    light,
                }));
            }
            Err(error) => tracing::debug!("a preview could not be encoded: {error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Part, Previews};
    use crate::acquire::preview::Taps;
    use crate::base::ids::CameraId;
    use std::sync::Arc;

    #[test]
    fn a_camera_that_is_not_there_is_named_with_those_that_are() {
        let taps = Arc::new(Taps::new([CameraId::from("h0_up"), CameraId::from("h0_low")]));
        let previews = Previews::start(taps).expect("a thread");
        let error = previews.latest("h9_up", Part::Whole).expect_err("not there").to_string();
        assert!(error.contains("h9_up") && error.contains("h0_up, h0_low"), "{error}");
        assert!(previews.latest("h0_low", Part::Light).expect("there").is_none(), "no frame yet");
        assert_eq!(previews.facts().len(), 2);
    }
}
