//! What each witness says of a frame: its timestamp by the relation of the clocks, its arrival, and the frames before it.

use super::{Case, Matcher, Sighting};
use crate::acquire::clock::ClockFit;
use crate::acquire::trigger_table::Schedule;

/// More than arrivals can be late or early against each other, ns: a timestamp that runs ahead by more was reset.
const ARRIVAL_SLACK_NS: i128 = 500_000_000;
/// So long a tracker is believed without a frame before the fits are asked, ns.
const TRACKER_REACH_NS: i128 = 2_000_000_000;

/// Where a timestamp points.
pub(super) enum ByTime {
    /// At a trigger, this far after it.
    Trigger(i64, i128),
    /// Later than every trigger reported so far.
    Beyond,
    /// The clocks' relation is not known.
    Unknown,
}

impl Matcher {
    /// A quarter of a period once frames have taught the clocks' relation, half a period before.
    pub(super) fn tolerance_ns(&self) -> i128 {
        let settled = self.tracker.is_some_and(|tracker| tracker.is_settled());
        i128::from(self.period_ns) / if settled { 4 } else { 2 }
    }

    /// What two frames' distance may differ by where one clock timed both.
    pub(super) fn tight_ns(&self) -> i128 {
        let spread = self.tracker.map_or(0.0, |tracker| tracker.spread_ns);
        (i128::from(self.period_ns) / 16).max((spread * 6.0) as i128).min(self.tolerance_ns())
    }

    /// What the residuals of an unchanged clock do not exceed.
    pub(super) fn sharp_ns(&self) -> i128 {
        let spread = self.tracker.map_or(0.0, |tracker| tracker.spread_ns);
        (i128::from(self.period_ns) / 64).max((spread * 6.0) as i128)
    }

    /// The trigger that its timestamp points at.
    pub(super) fn by_time(&self, camera_ns: u64, host_ns: u64, case: &Case<'_>) -> ByTime {
        let Some(hsu_ns) = self.hsu_ns(camera_ns, host_ns, case.hsu) else { return ByTime::Unknown };
        let half = i128::from(self.period_ns / 2);
        match case.table.nearest(hsu_ns).zip(case.table.latest_ns()) {
            Some((_, latest)) if hsu_ns > i128::from(latest) + half => ByTime::Beyond,
            Some(((number, residual), _)) => ByTime::Trigger(number, residual),
            None => ByTime::Beyond,
        }
    }

    /// A frame's time on the HSU's clock: by the frames before it, else by the fits, else by what was measured
    /// before the session, else by its arrival.
    pub(super) fn hsu_ns(&self, camera_ns: u64, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let fits = self.by_fits(camera_ns, hsu);
        if let Some(tracker) = &self.tracker {
            let tracked = tracker.hsu_ns(camera_ns);
            let near = (tracked - tracker.last_hsu_ns()).abs() <= TRACKER_REACH_NS;
            let contradicted = self.camera.used() >= 3
                && fits.is_some_and(|fits| (fits - tracked).abs() > i128::from(self.period_ns) * 3 / 4);
            if !contradicted && (near || fits.is_none()) {
                return Some(tracked);
            }
        }
        let measured = self.clocks.camera_minus_hsu_ns.map(|offset| i128::from(camera_ns) - offset);
        let arrived = || Some(self.arrival_hsu_ns(host_ns, hsu)? - i128::from(self.period_ns / 4));
        fits.or(measured).or_else(arrived)
    }

    /// HSU time of a timestamp by the clock exchanges alone, where they are sure enough.
    pub(super) fn by_fits(&self, camera_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let host_ns = self.camera.host_from_device(camera_ns.into())?;
        let hsu_ns = hsu.device_from_host(host_ns)?;
        let unsure =
            self.camera.uncertainty_ns(camera_ns.into())?.saturating_add(hsu.uncertainty_ns(hsu_ns)?);
        (unsure < self.period_ns / 3).then_some(hsu_ns)
    }

    /// When a frame arrived, HSU time.
    pub(super) fn arrival_hsu_ns(&self, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        let measured = || Some(i128::from(host_ns) + self.clocks.hsu_minus_host_ns?);
        hsu.device_from_host(host_ns.into()).or_else(measured)
    }

    /// The trigger that its arrival points at, where arrivals are regular.
    pub(super) fn by_arrival(&self, host_ns: u64, table: &Schedule<'_>, hsu: &ClockFit) -> Option<i64> {
        let hsu_ns = self.usual_arrival(host_ns, hsu)?;
        let near = |(_, residual): &(i64, i128)| residual.abs() <= i128::from(self.period_ns / 2);
        table.nearest(hsu_ns).filter(near).map(|(number, _)| number)
    }

    /// When a frame's trigger was fired if it took the usual time to arrive, HSU time, where arrivals are regular.
    pub(super) fn usual_arrival(&self, host_ns: u64, hsu: &ClockFit) -> Option<i128> {
        Some(self.arrival_hsu_ns(host_ns, hsu)? - self.latency.usual_ns(self.period_ns)?)
    }

    /// Whether a timestamp says that the frame was exposed after it arrived.
    pub(super) fn is_ahead(&self, case: &Case<'_>, camera_ns: u64) -> bool {
        let arrived = self.arrival_hsu_ns(case.frame.host_ns, case.hsu);
        let exposed = self.tracker.map(|tracker| tracker.hsu_ns(camera_ns));
        arrived.zip(exposed).is_some_and(|(arrived, exposed)| exposed > arrived + i128::from(self.period_ns))
    }

    /// Whether a frame arrived before a trigger was fired.
    pub(super) fn precedes(&self, case: &Case<'_>, number: i64) -> bool {
        let arrived = self.arrival_hsu_ns(case.frame.host_ns, case.hsu).zip(case.table.time_ns(number));
        arrived.is_some_and(|(arrived, due)| arrived + i128::from(self.period_ns / 8) < due.into())
    }

    /// The latest trigger that was fired before a frame arrived.
    pub(super) fn fired_before(&self, case: &Case<'_>) -> Option<i64> {
        let (number, residual) = case.table.nearest(self.arrival_hsu_ns(case.frame.host_ns, case.hsu)?)?;
        Some(if residual < 0 { number - 1 } else { number })
    }

    /// Whether the trigger of this number had not been fired yet when a frame arrived, by several periods.
    pub(super) fn is_yet_to_come(&self, case: &Case<'_>, number: i64) -> bool {
        const PERIODS: i128 = 3;
        let ahead = number.saturating_sub(case.table.end().saturating_sub(1));
        let arrived = self.arrival_hsu_ns(case.frame.host_ns, case.hsu);
        let Some((arrived, latest)) = arrived.zip(case.table.latest_ns()).filter(|_| ahead > 0) else {
            return false;
        };
        // Triggers come no faster than 8/7 of the rate (`hsu-protocol.md`, invariant 5).
        let due = i128::from(latest) + i128::from(ahead) * i128::from(self.period_ns) * 7 / 8;
        arrived + PERIODS * i128::from(self.period_ns) < due
    }

    /// Whether a torn frame has an id that is not due. Whoever sent it, ids and triggers go on without it; was it the
    /// camera after all, the next frame says so.
    pub(super) fn is_stray(&self, case: &Case<'_>) -> bool {
        let settled = |id: i64| self.last.is_some_and(|last| id <= last.number);
        let stray = |id: i64| settled(id) || self.is_yet_to_come(case, id);
        !case.frame.complete && case.by_id.is_some_and(stray)
    }

    /// The same frame once more, or one from before the last.
    pub(super) fn is_repeated(&self, frame: &Sighting, step: Option<i64>) -> bool {
        let Some((last, step)) = self.last.zip(step) else { return false };
        match frame.camera_ns.zip(last.camera_ns) {
            Some((now, before)) => (step == 0 && now == before) || (step < 0 && now < before),
            None => step <= 0,
        }
    }

    /// A clock that went back, or ran ahead of all arrivals, while the ids went on.
    pub(super) fn is_certainly_reset(&self, frame: &Sighting) -> bool {
        let Some(last) = self.last else { return false };
        let Some((now, before)) = frame.camera_ns.zip(last.camera_ns) else { return false };
        let camera = i128::from(now) - i128::from(before);
        camera <= 0 || camera - (i128::from(frame.host_ns) - i128::from(last.host_ns)) > ARRIVAL_SLACK_NS
    }
}
