// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a device's clock runs against the host's, from exchanges and from one-way reports.
//!
//! An exchange proves one thing: the device's clock showed its reading somewhere between the sending of
//! the question and the arrival of the answer. Over a window every exchange is thus a lower and an upper bound on
//! a straight line (offset and skew), and a report without a question is an upper bound. Delays only ever add,
//! so the line is looked for between the bounds, not through their middles: the fastest question and the fastest
//! answer count, even when they belong to different exchanges. (Cf. Moon, Skelly and Towsley, "Estimation and
//! removal of clock skew from network delay measurements", INFOCOM 1999, who do this for one direction.)
//! No method can measure a constant difference between the delays of the two directions: half of it remains as an
//! error, and it is part of the stated uncertainty.

use std::collections::VecDeque;

/// One question for a device's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exchange {
    /// Question sent, host clock, ns.
    pub host_send_ns: u64,
    /// Answer received, host clock, ns.
    pub host_receive_ns: u64,
    /// The device's reading, ns of its clock.
    pub device_ns: u64,
}

/// How the fit has taken an exchange.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Judged {
    /// It agrees with the fit, and its bounds are in the fit now.
    Used,
    /// It cannot be explained by its round trip and the fit's uncertainty; left out.
    LeftOut,
    /// A run of exchanges contradicts the fit and agrees with itself: the device's clock was set anew, and so is the
    /// fit. The device's reading of one instant changed by this much, ns.
    Reset {
        /// New reading minus old reading.
        step_ns: i128,
    },
}

/// Length of the window of which bounds are kept, ns of the device's clock: a rate changes little within a minute.
const WINDOW_NS: i64 = 60_000_000_000;
/// Length of a sub-window, ns: of each, only the tightest bounds are kept, so that a fit holds at most 120 of each
/// kind.
const SUB_WINDOW_NS: i64 = 500_000_000;
/// No clock runs faster or slower than the host's by more: crystals stay within 100 ppm, a host whose clock is
/// being slewed within 500.
const SKEW_LIMIT: f64 = 500e-6;
/// The skew to expect before anything is measured: crystals differ from their nominal rate by about this much.
const LIKELY_SKEW: f64 = 100e-6;
/// How fast a rate may change without being measured: a bound is widened by this for each ns of its age.
const WANDER: f64 = 0.5e-6;
/// The least error of reading a clock, ns: no contradiction below it is one.
const READING_NS: f64 = 1_000.0;
/// This number of contradictions in a row is a reset: fewer may be packets that were delayed.
pub const RESET_RUN: usize = 3;
/// After one-way reports the line is drawn anew at most this often, ns.
const REDRAW_NS: f64 = 250e6;

/// A bound on host time minus device time (both from the origin), ns, at a device time.
#[derive(Debug, Clone, Copy)]
struct Bound {
    x: f64,
    y: f64,
}

/// The tightest bounds of a stretch of time.
#[derive(Debug)]
struct SubWindow {
    number: i64,
    lower: Option<Bound>,
    upper: Option<Bound>,
    /// The number of bounds that the tightest ones were chosen from.
    lowers: u32,
    uppers: u32,
    round_trip: Option<f64>,
}

/// `host - device = offset + skew * device`, all from the origin.
#[derive(Debug, Clone, Copy)]
struct Line {
    offset: f64,
    skew: f64,
    /// What the bounds leave open.
    skew_min: f64,
    skew_max: f64,
    drawn_at: f64,
}

/// A device's clock against the host's. Whoever reads the device's clock makes a fit and gives it every exchange and
/// every report; from the second reading on it converts times of one clock to the other, with an uncertainty that it
/// states. It ends with the link to the device; where the device's clock is set meanwhile, it begins anew by itself
/// ([`Judged::Reset`]).
#[derive(Debug, Default)]
pub struct ClockFit {
    /// Device and host time from which all else is measured.
    origin: Option<(u64, u64)>,
    windows: VecDeque<SubWindow>,
    line: Option<Line>,
    newest: f64,
    /// Whether two readings differ: before that the clock may stand still.
    runs: bool,
    suspects: Vec<Exchange>,
    used: u64,
    left_out: u64,
    resets: u64,
}

impl ClockFit {
    /// A fit without any exchange.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes an exchange into account.
    pub fn exchange(&mut self, exchange: &Exchange) -> Judged {
        if exchange.host_receive_ns < exchange.host_send_ns {
            self.left_out += 1;
            return Judged::LeftOut;
        }
        let (x, lower) = self.place(exchange.device_ns, exchange.host_send_ns);
        let upper = self.place(exchange.device_ns, exchange.host_receive_ns).1;
        if let Some((least, most)) = self.interval(x)
            && (upper < least - READING_NS || lower > most + READING_NS)
        {
            return self.suspect(*exchange);
        }
        self.suspects.clear();
        self.used += 1;
        self.enter(x, Some(lower), Some(upper));
        self.draw();
        Judged::Used
    }

    /// Takes a report into account that left the device at `device_ns` or later and arrived at
    /// `host_receive_ns`: an upper bound, some hundred of them each second.
    pub fn heard(&mut self, device_ns: u64, host_receive_ns: u64) {
        if self.origin.is_none() {
            return;
        }
        let (x, upper) = self.place(device_ns, host_receive_ns);
        if self.interval(x).is_some_and(|(least, _)| upper < least - READING_NS) {
            return;
        }
        self.enter(x, None, Some(upper));
        if self.line.is_none_or(|line| x - line.drawn_at > REDRAW_NS) {
            self.draw();
        }
    }

    /// The host's time, ns, when the device's clock shows `device_ns`.
    pub fn host_from_device(&self, device_ns: i128) -> Option<i128> {
        let ((device, host), line) = self.origin.zip(self.line)?;
        let x = device_ns - i128::from(device);
        Some(i128::from(host) + x + (line.offset + line.skew * x as f64).round() as i128)
    }

    /// What the device's clock shows, ns, at a time of the host.
    pub fn device_from_host(&self, host_ns: i128) -> Option<i128> {
        let ((device, host), line) = self.origin.zip(self.line)?;
        let since = host_ns - i128::from(host);
        // x + offset + skew x = since, solved for the small difference to keep the large part exact.
        let difference = (line.offset + line.skew * since as f64) / (1.0 + line.skew);
        Some(i128::from(device) + since - difference.round() as i128)
    }

    /// Half the width of what the bounds leave open at a device time, and at least half the shortest round trip
    /// of the window, ns.
    pub fn uncertainty_ns(&self, device_ns: i128) -> Option<u64> {
        let (device, _) = self.origin?;
        let (least, most) = self.interval((device_ns - i128::from(device)) as f64)?;
        let round_trips = self.windows.iter().filter_map(|window| window.round_trip);
        let shortest = round_trips.fold(f64::INFINITY, f64::min);
        Some(((most - least).max(shortest) / 2.0).ceil() as u64)
    }

    /// How much faster the device's clock runs than the host's, parts per million.
    pub fn drift_ppm(&self) -> Option<f64> {
        self.line.map(|line| -line.skew / (1.0 + line.skew) * 1e6)
    }

    /// Whether there is a fit.
    pub fn is_ready(&self) -> bool {
        self.line.is_some()
    }

    /// The number of exchanges whose bounds entered the fit.
    pub fn used(&self) -> u64 {
        self.used
    }

    /// Exchanges that were left out.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// How often the device's clock was found to be set anew.
    pub fn resets(&self) -> u64 {
        self.resets
    }

    /// Device time from the origin, and host minus device time.
    fn place(&mut self, device_ns: u64, host_ns: u64) -> (f64, f64) {
        let (device, host) = *self.origin.get_or_insert((device_ns, host_ns));
        let x = i128::from(device_ns) - i128::from(device);
        (x as f64, (i128::from(host_ns) - i128::from(host) - x) as f64)
    }

    /// Keeps what is tighter than what its sub-window has.
    fn enter(&mut self, x: f64, lower: Option<f64>, upper: Option<f64>) {
        self.newest = self.newest.max(x);
        // The origin is the first reading.
        self.runs |= x != 0.0;
        let skew = self.line.map_or(0.0, |line| line.skew);
        let number = (x / SUB_WINDOW_NS as f64).floor() as i64;
        let oldest = (self.newest / SUB_WINDOW_NS as f64).floor() as i64 - WINDOW_NS / SUB_WINDOW_NS;
        while self.windows.front().is_some_and(|window| window.number < oldest) {
            self.windows.pop_front();
        }
        if number < oldest {
            return;
        }
        let place = self.windows.partition_point(|window| window.number < number);
        if self.windows.get(place).is_none_or(|window| window.number != number) {
            let empty =
                SubWindow { number, lower: None, upper: None, lowers: 0, uppers: 0, round_trip: None };
            self.windows.insert(place, empty);
        }
        let window = &mut self.windows[place];
        let level = |bound: Bound| bound.y - skew * bound.x;
        if let Some(bound) = lower.map(|y| Bound { x, y }) {
            window.lower = Some(window.lower.filter(|held| level(*held) >= level(bound)).unwrap_or(bound));
            window.lowers += 1;
        }
        if let Some(bound) = upper.map(|y| Bound { x, y }) {
            window.upper = Some(window.upper.filter(|held| level(*held) <= level(bound)).unwrap_or(bound));
            window.uppers += 1;
        }
        if let Some((lower, upper)) = lower.zip(upper) {
            window.round_trip = Some(window.round_trip.unwrap_or(f64::INFINITY).min(upper - lower));
        }
    }

    fn lowers(&self) -> impl Iterator<Item = Bound> + '_ {
        let newest = self.newest;
        self.windows
            .iter()
            .filter_map(|window| window.lower)
            .map(move |b| Bound { y: b.y - WANDER * (newest - b.x), ..b })
    }

    fn uppers(&self) -> impl Iterator<Item = Bound> + '_ {
        let newest = self.newest;
        self.windows
            .iter()
            .filter_map(|window| window.upper)
            .map(move |b| Bound { y: b.y + WANDER * (newest - b.x), ..b })
    }

    /// Draws the line anew. Where bounds contradict each other, the oldest sub-windows are dropped until they do not;
    /// the answer is whether none was dropped.
    fn draw(&mut self) -> bool {
        let mut complete = true;
        self.line = loop {
            match self.skews() {
                Some((skew_min, skew_max)) => break self.between(skew_min, skew_max),
                None => {
                    complete = false;
                    if self.windows.pop_front().is_none() {
                        break None;
                    }
                }
            }
        };
        complete
    }

    /// The skews with which some line keeps all bounds: of each lower and upper bound, the later one limits how
    /// steeply the line may leave the earlier one.
    fn skews(&self) -> Option<(f64, f64)> {
        let (mut least, mut most) = (-SKEW_LIMIT, SKEW_LIMIT);
        for lower in self.lowers() {
            for upper in self.uppers() {
                let (dx, dy) = (upper.x - lower.x, upper.y - lower.y);
                if dx > 0.0 {
                    most = most.min(dy / dx);
                } else if dx < 0.0 {
                    least = least.max(dy / dx);
                } else if dy < 0.0 {
                    return None;
                }
            }
        }
        (least <= most).then_some((least, most))
    }

    /// The skew by least squares over the tightest bounds, lower and upper ones each about their own mean. The
    /// fastest of n delays varies as 1/n: weights are n squared. Skews are around 100 ppm before anything is known.
    fn likely_skew(&self) -> f64 {
        let sides = [
            (|w: &SubWindow| w.lower.map(|b| (b, f64::from(w.lowers))))
                as fn(&SubWindow) -> Option<(Bound, f64)>,
            |w: &SubWindow| w.upper.map(|b| (b, f64::from(w.uppers))),
        ];
        let (mut covariance, mut variance) = (0.0, 0.0);
        for side in sides {
            let bounds = || self.windows.iter().filter_map(side).map(|(b, n)| (b, n * n));
            let total: f64 = bounds().map(|(_, w)| w).sum();
            if total == 0.0 {
                continue;
            }
            let mean_x = bounds().map(|(b, w)| w * b.x).sum::<f64>() / total;
            let mean_y = bounds().map(|(b, w)| w * b.y).sum::<f64>() / total;
            covariance += bounds().map(|(b, w)| w * (b.x - mean_x) * (b.y - mean_y)).sum::<f64>();
            variance += bounds().map(|(b, w)| w * (b.x - mean_x).powi(2)).sum::<f64>();
        }
        let trips = || self.windows.iter().filter_map(|window| window.round_trip);
        let spread = trips().sum::<f64>() / trips().count().max(1) as f64;
        covariance / (variance + (spread / LIKELY_SKEW).powi(2)).max(f64::MIN_POSITIVE)
    }

    /// The most likely line of those that keep all bounds, midway between them. A clock that was seen at one reading
    /// only may be standing still.
    fn between(&self, skew_min: f64, skew_max: f64) -> Option<Line> {
        if !self.runs {
            return None;
        }
        let skew = self.likely_skew().clamp(skew_min, skew_max);
        let least = self.lowers().map(|b| b.y - skew * b.x).fold(f64::NEG_INFINITY, f64::max);
        let most = self.uppers().map(|b| b.y - skew * b.x).fold(f64::INFINITY, f64::min);
        let bounded = least.is_finite() && most.is_finite();
        let offset = (least + most) / 2.0;
        bounded.then_some(Line { offset, skew, skew_min, skew_max, drawn_at: self.newest })
    }

    /// Where host minus device time can lie at `x`.
    fn interval(&self, x: f64) -> Option<(f64, f64)> {
        let line = self.line?;
        let lower = |b: Bound| b.y + (x - b.x) * if x >= b.x { line.skew_min } else { line.skew_max };
        let upper = |b: Bound| b.y + (x - b.x) * if x >= b.x { line.skew_max } else { line.skew_min };
        let age = WANDER * (x - self.newest).max(0.0);
        let least = self.lowers().map(lower).fold(f64::NEG_INFINITY, f64::max) - age;
        let most = self.uppers().map(upper).fold(f64::INFINITY, f64::min) + age;
        Some((least.min(most), most.max(least)))
    }

    fn suspect(&mut self, exchange: Exchange) -> Judged {
        self.left_out += 1;
        self.suspects.push(exchange);
        if self.suspects.len() < RESET_RUN {
            return Judged::LeftOut;
        }
        let mut fresh = Self::new();
        let agree = self.suspects.iter().all(|exchange| {
            let (x, lower) = fresh.place(exchange.device_ns, exchange.host_send_ns);
            let upper = fresh.place(exchange.device_ns, exchange.host_receive_ns).1;
            fresh.enter(x, Some(lower), Some(upper));
            fresh.draw()
        });
        if !agree || !fresh.is_ready() {
            self.suspects.remove(0);
            return Judged::LeftOut;
        }
        let host = (i128::from(exchange.host_send_ns) + i128::from(exchange.host_receive_ns)) / 2;
        let old = self.device_from_host(host).unwrap_or_default();
        let step_ns = fresh.device_from_host(host).unwrap_or_default() - old;
        let run = self.suspects.len() as u64;
        fresh.used = self.used + run;
        fresh.left_out = self.left_out - run;
        fresh.resets = self.resets + 1;
        *self = fresh;
        Judged::Reset { step_ns }
    }
}

#[cfg(test)]
mod tests;
