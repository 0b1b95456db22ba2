// SPDX-License-Identifier: MIT OR Apache-2.0
//! Notices, from trigger to trigger, which cameras have stopped sending. Pure.

/// Triggers that pass without a packet of a camera before it counts as silent.
pub const SILENT_TRIGGERS: u64 = 3;

/// A camera has stopped sending, or sends again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Notice {
    /// The camera sent nothing for [`SILENT_TRIGGERS`] triggers.
    Silent {
        camera: usize,
        /// The first of these triggers.
        since: u64,
    },
    HeardAgain {
        camera: usize,
        /// The trigger at which that was noticed.
        at: u64,
    },
}

#[derive(Debug, Clone, Copy, Default)]
struct Counter {
    heard: u64,
    /// The first trigger after which nothing was received.
    quiet_since: u64,
    silent: bool,
}

/// All cameras of a node.
#[derive(Debug)]
pub struct SilenceWatch {
    counters: Vec<Counter>,
}

impl SilenceWatch {
    /// A watch of this many cameras, none of them silent.
    pub fn new(cameras: usize) -> Self {
        Self { counters: vec![Counter::default(); cameras] }
    }

    /// Whether a camera is silent now.
    pub fn is_silent(&self, camera: usize) -> bool {
        self.counters.get(camera).is_some_and(|counter| counter.silent)
    }

    /// A trigger was reported close behind another one, because reports were held up: it makes no camera silent.
    pub fn pass_over(&mut self) {
        for counter in self.counters.iter_mut().filter(|counter| !counter.silent) {
            counter.quiet_since += 1;
        }
    }

    /// Trigger `index` was reported; `heard` are the counters of received packets, one a camera.
    pub fn on_trigger(&mut self, index: u64, heard: impl IntoIterator<Item = u64>) -> Vec<Notice> {
        let mut notices = Vec::new();
        for (camera, (counter, heard)) in self.counters.iter_mut().zip(heard).enumerate() {
            if heard != counter.heard {
                // The packets so far may belong to the frame of an earlier trigger: those of this one are yet to come.
                (counter.heard, counter.quiet_since) = (heard, index);
                if std::mem::take(&mut counter.silent) {
                    notices.push(Notice::HeardAgain { camera, at: index });
                }
            } else if !counter.silent && index >= counter.quiet_since + SILENT_TRIGGERS {
                counter.silent = true;
                notices.push(Notice::Silent { camera, since: counter.quiet_since });
            }
        }
        notices
    }
}

#[cfg(test)]
mod tests {
    use super::{Notice, SILENT_TRIGGERS, SilenceWatch};
    use proptest::prelude::{prop_assert, prop_assert_eq, proptest};

    proptest! {
        #[test]
        fn silence_is_noticed_in_three_triggers_and_once(start in 1u64..500, length in 1u64..60) {
            let mut watch = SilenceWatch::new(2);
            let (mut heard, mut notices) = (0, Vec::new());
            for trigger in 0..start + length + 20 {
                notices.extend(watch.on_trigger(trigger, [heard, trigger]));
                if !(start..start + length).contains(&trigger) {
                    heard += 17;
                }
            }
            let silent: Vec<Notice> = notices.iter().copied().filter(|n| matches!(n, Notice::Silent { .. })).collect();
            let of = |n: &Notice| match n {
                Notice::Silent { camera, .. } | Notice::HeardAgain { camera, .. } => *camera,
            };
            prop_assert_eq!(notices.iter().filter(|n| of(n) != 0).count(), 0, "the other camera never fell silent");
            if length >= SILENT_TRIGGERS {
                prop_assert_eq!(silent, [Notice::Silent { camera: 0, since: start }]);
                prop_assert_eq!(notices.len(), 2, "and it was heard again");
            } else {
                prop_assert!(notices.is_empty());
            }
        }
    }

    #[test]
    fn reports_that_come_all_at_once_are_no_silence() {
        let mut watch = SilenceWatch::new(1);
        assert!(watch.on_trigger(0, [5]).is_empty());
        (1..20).for_each(|_| watch.pass_over());
        assert!((20..22).all(|trigger| watch.on_trigger(trigger, [5]).is_empty()));
        assert_eq!(watch.on_trigger(22, [5]), [Notice::Silent { camera: 0, since: 19 }]);
    }

    #[test]
    fn a_camera_that_never_sends_is_noticed() {
        let mut watch = SilenceWatch::new(1);
        let notices: Vec<Notice> = (0..10).flat_map(|k| watch.on_trigger(k, [0])).collect();
        assert_eq!(notices, [Notice::Silent { camera: 0, since: 0 }]);
        assert!(watch.is_silent(0));
    }
}
