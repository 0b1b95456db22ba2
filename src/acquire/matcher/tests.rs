//! Seeded fault sequences against a reference that knows what happened.

use super::{ClockRelation, Finding, Match, Matched, Matcher, Sighting};
use crate::acquire::clock::{ClockFit, Exchange};
use crate::acquire::trigger_table::TriggerTable;
use crate::ids::BlockId;
use proptest::prelude::{ProptestConfig, any, prop_assert, proptest};
use std::collections::VecDeque;

const PERIOD_NS: u64 = 8_333_333;
const HSU_NS: u64 = 3_000_000_000;
const HOST_NS: u64 = 1_790_000_000_000_000_000;

struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 16
    }

    fn below(&mut self, bound: u64) -> u64 {
        self.next() % bound.max(1)
    }

    /// Once in `n`.
    fn one_in(&mut self, n: u64) -> bool {
        self.below(n) == 0
    }
}

/// What became of a trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Truth {
    Frame,
    Lost,
    Ignored,
}

/// What a delivered frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Is {
    Of(i64),
    Extra,
    Duplicate,
}

struct Camera {
    random: Random,
    wide: bool,
    count: u64,
    clock_ns: i128,
    ppm: f64,
    delivered: Vec<(Sighting, Is, Option<Finding>)>,
    truth: Vec<Truth>,
    /// Triggers of which two explanations are the same to any observer.
    ambiguous: Vec<bool>,
    faults: u64,
}

fn due(number: i64) -> u64 {
    HSU_NS.saturating_add_signed((number * PERIOD_NS as i64) + 1_000_000_000)
}

impl Camera {
    fn id(&self) -> BlockId {
        BlockId(if self.wide { 70_000 + self.count } else { (self.count - 1) % 65_535 + 1 })
    }

    fn timestamp(&mut self, hsu_ns: u64) -> u64 {
        let jitter = self.random.below(40_000) as i128 - 20_000;
        let drift = ((hsu_ns - HSU_NS) as f64 * self.ppm * 1e-6) as i128;
        (i128::from(hsu_ns) + self.clock_ns + drift + jitter) as u64
    }

    fn deliver(&mut self, hsu_ns: u64, is: Is, complete: bool, leader: bool, finding: Option<Finding>) {
        let straggler = if self.random.one_in(200) { self.random.below(20_000_000) } else { 0 };
        let host_ns = HOST_NS + (hsu_ns - HSU_NS) + 3_000_000 + self.random.below(300_000) + straggler;
        let host_ns = self.delivered.last().map_or(host_ns, |(last, ..)| host_ns.max(last.host_ns));
        let camera_ns = leader.then(|| self.timestamp(hsu_ns));
        self.delivered.push((Sighting { id: self.id(), camera_ns, host_ns, complete }, is, finding));
    }

    /// Holds frames up: all of a stall arrive at its end.
    fn hold_up(&mut self) {
        let mut until = 0;
        for k in 0..self.delivered.len() {
            if self.random.one_in(400) {
                until = self.delivered[k].0.host_ns + self.random.below(30 * PERIOD_NS);
            }
            self.delivered[k].0.host_ns = self.delivered[k].0.host_ns.max(until);
        }
    }

    /// A session with all faults mixed.
    fn run(seed: u64, wide: bool, triggers: i64) -> Self {
        let mut random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        let count = 1 + random.below(65_534);
        let ppm = random.below(200) as f64 - 100.0;
        let mut camera = Self {
            random,
            wide,
            count,
            ppm,
            clock_ns: 77_000_000_000_000,
            delivered: Vec::new(),
            truth: Vec::new(),
            ambiguous: Vec::new(),
            faults: 0,
        };
        let mut calm = 40;
        let mut number = -32;
        while number < triggers {
            // Two faults of the same moment are drawn as one; others keep a frame between them.
            let fault = if calm > 0 { 99 } else { camera.random.below(40) };
            calm -= 1;
            let before = camera.truth.len();
            number += camera.fault(fault, number, triggers, &mut calm);
            if camera.truth.len() != before || fault < 10 {
                camera.faults += 1;
            }
            if number >= triggers {
                break;
            }
            camera.plain(number);
            number += 1;
        }
        camera
    }

    fn plain(&mut self, number: i64) {
        self.count += 1;
        self.deliver(due(number), Is::Of(number), true, true, None);
        self.outcome(number, Truth::Frame, false);
    }

    fn outcome(&mut self, number: i64, truth: Truth, ambiguous: bool) {
        if number >= 0 {
            self.truth.push(truth);
            self.ambiguous.push(ambiguous);
        }
    }

    fn miss(&mut self, first: i64, lost: i64, ignored: i64, triggers: i64) -> i64 {
        let total = (lost + ignored).min(triggers - first).max(0);
        for k in 0..total {
            let gone = k < lost;
            self.count += u64::from(gone);
            self.outcome(first + k, if gone { Truth::Lost } else { Truth::Ignored }, lost > 0 && ignored > 0);
        }
        total
    }

    /// Draws a fault before trigger `number`; returns how many triggers it took.
    fn fault(&mut self, fault: u64, number: i64, triggers: i64, calm: &mut i64) -> i64 {
        let few = 1 + self.random.below(4) as i64;
        match fault {
            0 => self.miss(number, few, 0, triggers),
            1 => self.miss(number, 0, few, triggers),
            2 => self.miss(number, few, 1 + few % 2, triggers),
            3 => {
                let jump = 1 + self.random.below(1000) as i64;
                self.count += jump as u64;
                self.count += 1;
                self.deliver(due(number), Is::Of(number), true, true, Some(Finding::IdJump(jump)));
                self.outcome(number, Truth::Frame, false);
                1
            }
            4 => {
                self.deliver(due(number), Is::Of(number), true, true, Some(Finding::IdRepeated));
                self.outcome(number, Truth::Frame, false);
                1
            }
            5 => {
                self.count += 1;
                let phase = PERIOD_NS / 5 + self.random.below(PERIOD_NS / 2);
                self.deliver(due(number - 1) + phase, Is::Extra, true, true, None);
                0
            }
            6 => {
                if let Some((last, ..)) = self.delivered.last().copied() {
                    self.delivered.push((last, Is::Duplicate, None));
                }
                0
            }
            7 => {
                // Torn, with or without its leader.
                self.count += 1;
                let leader = self.random.one_in(2);
                self.deliver(due(number), Is::Of(number), false, leader, None);
                self.outcome(number, Truth::Frame, false);
                1
            }
            8 | 9 => self.clock_reset(number, triggers, calm),
            _ => 0,
        }
    }

    /// To zero, back or ahead by little or much; now and then with frames lost at the same moment.
    fn clock_reset(&mut self, number: i64, triggers: i64, calm: &mut i64) -> i64 {
        *calm = 24;
        let lost = if self.random.one_in(3) { self.miss(number, 2, 0, triggers) } else { 0 };
        let number = number + lost;
        if number >= triggers {
            return lost;
        }
        let by = match self.random.below(4) {
            0 => -i128::from(self.random.below(70_000_000_000_000)),
            1 => i128::from(self.random.below(70_000_000_000_000)),
            2 => i128::from(self.random.below(400_000_000)) + 9_000_000,
            _ => -(i128::from(self.random.below(1_000_000_000)) + 9_000_000),
        };
        if self.clock_ns + by < 1_000_000_000 {
            return lost;
        }
        self.clock_ns += by;
        self.count += 1;
        self.deliver(due(number), Is::Of(number), true, true, Some(Finding::ClockReset(by)));
        self.outcome(number, Truth::Frame, false);
        lost + 1
    }
}

fn hsu_clock() -> ClockFit {
    let mut fit = ClockFit::new();
    for k in 0..40u64 {
        let host_send_ns = HOST_NS + k * 20_000_000;
        let device_ns = HSU_NS + k * 20_000_000 + 100_000;
        fit.exchange(&Exchange { host_send_ns, host_receive_ns: host_send_ns + 200_000, device_ns });
    }
    fit
}

/// What was found out: outcomes by trigger, and what was wrong with single frames.
struct Found {
    outcomes: Vec<Option<Truth>>,
    wrong: Vec<String>,
}

impl Found {
    fn frame(&mut self, is: Is, finding: Option<Finding>, answer: Match, next: &mut i64) {
        let Match::Trigger(Matched { number, lost, ignored, finding: found, .. }) = answer else {
            if matches!(is, Is::Of(_)) {
                self.wrong.push(format!("{is:?} was taken for {answer:?}"));
            }
            return;
        };
        if is != Is::Of(number) {
            self.wrong.push(format!("{is:?} was taken for {number}"));
        }
        let same = match (finding, found) {
            (Some(Finding::ClockReset(_)), Some(Finding::ClockReset(_))) => true,
            (truth, found) => truth == found,
        };
        if !same {
            self.wrong.push(format!("{is:?}: {finding:?} was taken for {found:?}"));
        }
        let skipped = (number - *next).max(0);
        if *next >= -31 && skipped as u64 != lost + ignored {
            self.wrong.push(format!("{is:?}: {lost} lost and {ignored} ignored are not {skipped}"));
        }
        for k in 0..skipped {
            let truth = if (k as u64) < lost { Truth::Lost } else { Truth::Ignored };
            self.set(*next + k, truth);
        }
        self.set(number, Truth::Frame);
        *next = number + 1;
    }

    fn set(&mut self, number: i64, truth: Truth) {
        if let Some(outcome) = usize::try_from(number).ok().and_then(|n| self.outcomes.get_mut(n)) {
            *outcome = Some(truth);
        }
    }
}

/// Delivers the frames with reports that lag behind; returns faults and complaints.
fn play(seed: u64, wide: bool, triggers: i64) -> (u64, Vec<String>) {
    let (faults, _, complaints) = play_with(seed, wide, triggers, false);
    (faults, complaints)
}

/// Frames that may wait for a report when reports are held up.
const WAITING: usize = 16;

/// As [`play`]; with `stalls` the reports are held up now and then for longer than frames may wait, and frames for
/// as long. Returns faults, frames with a wrong trigger, and complaints.
fn play_with(seed: u64, wide: bool, triggers: i64, stalls: bool) -> (u64, Vec<String>, Vec<String>) {
    let mut camera = Camera::run(seed, wide, triggers);
    if stalls {
        camera.hold_up();
    }
    let hsu = hsu_clock();
    let coarse = camera.random.below(4_000_000) as i128 - 2_000_000;
    let clocks =
        ClockRelation { camera_minus_hsu_ns: Some(77_000_000_000_000 + coarse), hsu_minus_host_ns: None };
    let mut matcher = Matcher::new(PERIOD_NS, clocks);
    let mut table = TriggerTable::default();
    let mut found = Found { outcomes: vec![None; triggers as usize], wrong: Vec::new() };
    let mut waiting: VecDeque<(Sighting, Is, Option<Finding>)> = VecDeque::new();
    let (mut reported, mut next, mut misplaced) = (-32, -32, Vec::new());
    let (mut hold_until, mut first_hold) = (0, stalls && camera.random.one_in(2));
    let frames = std::mem::take(&mut camera.delivered);
    for (k, frame) in frames.iter().enumerate() {
        waiting.push_back(*frame);
        let lag_ns = if camera.random.one_in(50) { 60_000_000 } else { camera.random.below(6_000_000) };
        let end = k + 1 == frames.len();
        if stalls && (camera.random.one_in(300) || std::mem::take(&mut first_hold)) {
            hold_until = frame.0.host_ns + camera.random.below(40 * PERIOD_NS);
        }
        while (end || frame.0.host_ns >= hold_until)
            && reported < triggers
            && (end || HOST_NS + (due(reported) - HSU_NS) + lag_ns < frame.0.host_ns)
        {
            table.insert(reported, due(reported));
            reported += 1;
        }
        while let Some((sighting, is, finding)) = waiting.front().copied() {
            let ahead =
                waiting.iter().skip(1).map(|(next, ..)| next).find(|next| next.camera_ns.is_some()).copied();
            let last_call = end || (stalls && waiting.len() > WAITING);
            match matcher.assign(&sighting, ahead.as_ref(), &table, &hsu, last_call) {
                Match::Wait => break,
                answer => {
                    if let Match::Trigger(Matched { number, .. }) = answer
                        && is != Is::Of(number)
                        && number >= 0
                    {
                        misplaced.push(format!("{is:?} stands at {number}, block {}", sighting.id));
                    }
                    found.frame(is, finding, answer, &mut next);
                }
            }
            waiting.pop_front();
        }
    }
    let mut wrong = found.wrong;
    for (k, truth) in camera.truth.iter().enumerate().take(next.max(0) as usize) {
        if found.outcomes[k] != Some(*truth) && !camera.ambiguous[k] {
            wrong.push(format!("trigger {k}: {truth:?} was taken for {:?}", found.outcomes[k]));
        }
    }
    (camera.faults, misplaced, wrong)
}

/// The law of the matcher: more than 10^5 faults, each with the right trigger and cause.
#[test]
fn every_fault_is_told_apart() {
    let (mut faults, mut wrong) = (0, 0);
    for seed in 0..400 {
        let (count, complaints) = play(seed, seed % 2 == 0, 3_000);
        faults += count;
        wrong += complaints.len();
        for complaint in complaints.iter().take(1) {
            println!("seed {seed}: {complaint}");
        }
    }
    println!("{faults} faults, {wrong} mistakes");
    assert!(faults >= 100_000, "{faults} faults are too few");
    assert_eq!(wrong, 0);
}

/// Where reports and frames are held up for longer than frames may wait, and clocks are set at that very moment, what
/// happened is not always to be known. It must stay rare, and it must not go on.
#[test]
fn stalls_misplace_few_frames_and_only_for_a_moment() {
    let (mut faults, mut misplaced, mut sessions, mut long, mut given_up) = (0, 0, 0, 0, 0);
    for seed in 0..400 {
        let (count, wrong, complaints) = play_with(seed, seed % 2 == 0, 3_000, true);
        faults += count;
        misplaced += wrong.len();
        given_up += complaints.iter().filter(|text| text.ends_with("Undecided")).count();
        long += usize::from(wrong.len() > 50);
        if let Some(first) = wrong.first() {
            sessions += 1;
            println!("seed {seed}: {} misplaced, first: {first}", wrong.len());
        }
    }
    println!(
        "{faults} faults, {misplaced} frames misplaced in {sessions} of 400 sessions, in {long} of them for long; \
         {given_up} given up"
    );
    assert!(misplaced <= 100 && sessions <= 16 && long == 0);
    assert!(given_up <= 12_000, "{given_up} of 1.2 million frames");
}

/// A train whose source stands still now and then, with reports that are held up for longer than frames may wait: what
/// is only expected must not pass for a trigger. Frames may be given up, and none may be misplaced.
#[test]
fn a_train_that_pauses_while_its_reports_are_held_up_is_not_misnamed() {
    let (mut given_up, mut pauses) = (0, 0);
    for seed in 0..200 {
        let (paused, lost) = play_pausing(seed, 3_000);
        pauses += paused;
        given_up += lost;
    }
    println!("{pauses} pauses, {given_up} frames given up");
    assert!(pauses > 5_000, "{pauses}");
    assert!(given_up <= 1_000, "{given_up} of 600,000 frames");
}

/// No fault but pauses and late reports; returns how many pauses there were and how many frames were given up.
fn play_pausing(seed: u64, triggers: usize) -> (u64, u64) {
    let mut random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
    let (mut fired, mut at, mut pauses) = (Vec::new(), due(-32), 0);
    for _ in 0..triggers {
        fired.push(at);
        let pause = if random.one_in(100) { random.below(30 * PERIOD_NS) } else { 0 };
        pauses += u64::from(pause > 0);
        at += PERIOD_NS + pause;
    }
    let hsu = hsu_clock();
    let clocks = ClockRelation { camera_minus_hsu_ns: Some(0), hsu_minus_host_ns: None };
    let (mut matcher, mut table) = (Matcher::new(PERIOD_NS, clocks), TriggerTable::default());
    let (mut waiting, mut reported, mut hold_until, mut given_up) = (VecDeque::new(), 0, 0, 0);
    for (k, at) in fired.iter().enumerate() {
        let host_ns = host(*at) + random.below(300_000);
        waiting.push_back((k as i64 - 32, frame(1 + k as u64, *at + random.below(20_000), host_ns)));
        if random.one_in(150) {
            hold_until = host_ns + random.below(40 * PERIOD_NS);
        }
        let end = k + 1 == triggers;
        while (end || host_ns >= hold_until) && reported < triggers && fired[reported] < *at + 2_000_000 {
            table.insert(reported as i64 - 32, fired[reported]);
            reported += 1;
        }
        while let Some((truth, sighting)) = waiting.front().copied() {
            let next = waiting.get(1).map(|(_, next)| *next);
            let last_call = end || waiting.len() > WAITING;
            match matcher.assign(&sighting, next.as_ref(), &table, &hsu, last_call) {
                Match::Wait => break,
                Match::Trigger(matched) => assert_eq!(matched.number, truth, "seed {seed}"),
                Match::Undecided | Match::BeforeTrain => given_up += 1,
                other => panic!("seed {seed}: {truth} was taken for {other:?}"),
            }
            waiting.pop_front();
        }
    }
    (pauses, given_up)
}

fn frame(id: u64, camera_ns: u64, host_ns: u64) -> Sighting {
    Sighting { id: BlockId(id), camera_ns: Some(camera_ns), host_ns, complete: true }
}

fn number(answer: Match) -> i64 {
    match answer {
        Match::Trigger(matched) => matched.number,
        other => panic!("expected a trigger, found {other:?}"),
    }
}

fn full_table(triggers: i64) -> TriggerTable {
    let mut table = TriggerTable::default();
    (0..triggers).for_each(|k| table.insert(k, due(k)));
    table
}

fn host(hsu_ns: u64) -> u64 {
    HOST_NS + (hsu_ns - HSU_NS) + 3_000_000
}

fn sample(hsu_ns: u64, camera_ns: u64) -> Exchange {
    let at = HOST_NS + (hsu_ns - HSU_NS);
    Exchange { host_send_ns: at - 200_000, host_receive_ns: at + 200_000, device_ns: camera_ns }
}

#[test]
fn a_camera_without_a_readable_clock_is_matched_by_arrival() {
    let (hsu, table) = (hsu_clock(), full_table(10));
    let mut matcher = Matcher::new(PERIOD_NS, ClockRelation::default());
    let camera = |k: i64| due(k) + 500_000_000_000;
    let early = frame(60, camera(-1), host(due(-1)));
    assert_eq!(matcher.assign(&early, None, &TriggerTable::default(), &hsu, true), Match::BeforeTrain);
    assert_eq!(matcher.assign(&early, None, &table, &hsu, false), Match::BeforeTrain);
    for k in 0..10 {
        let frame = frame(61 + k as u64, camera(k), host(due(k)));
        assert_eq!(number(matcher.assign(&frame, None, &table, &hsu, false)), k);
    }
}

#[test]
fn a_frame_waits_for_its_report_and_then_its_id_must_do() {
    let hsu = ClockFit::new();
    let clocks = ClockRelation { camera_minus_hsu_ns: Some(0), hsu_minus_host_ns: None };
    let mut matcher = Matcher::new(PERIOD_NS, clocks);
    let first = frame(1, due(0), 0);
    assert_eq!(matcher.assign(&first, None, &full_table(0), &hsu, false), Match::Wait);
    assert_eq!(matcher.assign(&first, None, &full_table(0), &hsu, false), Match::Wait);
    assert_eq!(number(matcher.assign(&first, None, &full_table(1), &hsu, false)), 0);
    let second = frame(2, due(1), 0);
    assert_eq!(matcher.assign(&second, None, &full_table(1), &hsu, false), Match::Wait);
    assert_eq!(number(matcher.assign(&second, None, &full_table(1), &hsu, true)), 1);
}

/// A camera that comes back with new ids and a new clock, while a trigger's worth of everything was missed.
#[test]
fn a_camera_that_is_back_lands_on_the_right_trigger_by_its_new_clock() {
    let (hsu, table) = (hsu_clock(), full_table(200));
    let mut matcher = Matcher::new(PERIOD_NS, ClockRelation::default());
    for k in 0..20 {
        matcher.clock_sample(&sample(due(k), due(k) + 9_000_000_000_000));
    }
    for k in 0..20 {
        let frame = frame(500 + k as u64, due(k) + 9_000_000_000_000, host(due(k)));
        assert_eq!(number(matcher.assign(&frame, None, &table, &hsu, false)), k);
    }
    matcher.restart();
    for k in 100..110 {
        matcher.clock_sample(&sample(due(k), due(k) - HSU_NS));
    }
    for k in 120..140 {
        // The first one is a straggler: its arrival says nothing.
        let late = if k == 120 { 30_000_000 } else { 0 };
        let frame = frame(k as u64 - 119, due(k) - HSU_NS, host(due(k)) + late);
        assert_eq!(number(matcher.assign(&frame, None, &table, &hsu, false)), k);
    }
}

/// Triggers ignored at the moment of a reset: the ids cannot know, the new fit from clock samples can.
#[test]
fn a_new_fit_corrects_what_ids_alone_could_not_know() {
    let (hsu, table) = (hsu_clock(), full_table(300));
    let clocks = ClockRelation { camera_minus_hsu_ns: Some(0), hsu_minus_host_ns: None };
    let mut matcher = Matcher::new(PERIOD_NS, clocks);
    for k in 0..40 {
        let answer = matcher.assign(&frame(1 + k as u64, due(k), host(due(k))), None, &table, &hsu, false);
        assert_eq!(number(answer), k);
    }
    // Triggers 40 and 41 are ignored, the clock starts at zero.
    let zero = |k: i64| due(k) - due(30);
    let carried = matcher.assign(&frame(41, zero(42), host(due(42))), None, &table, &hsu, false);
    assert_eq!(number(carried), 40, "by its id alone");
    for k in 50..60 {
        matcher.clock_sample(&sample(due(k), zero(k)));
    }
    let [first, second] = [60, 61].map(|k| frame(k as u64 - 18, zero(k), host(due(k))));
    assert_eq!(matcher.assign(&first, None, &table, &hsu, false), Match::Wait);
    assert_eq!(number(matcher.assign(&first, Some(&second), &table, &hsu, false)), 60, "by the new fit");
    assert_eq!(number(matcher.assign(&second, None, &table, &hsu, false)), 61);
}

/// The rate of mistakes on seeds that no rule was tuned on; see docs/benchmarks.md, "Clocks".
#[test]
#[ignore = "8000 sessions, minutes; a figure for docs/benchmarks.md: cargo test --release --lib fresh_seeds -- --ignored --nocapture"]
fn mistakes_on_fresh_seeds_are_rare() {
    let (mut faults, mut sessions) = (0, 0);
    for seed in 90_000_000..90_008_000 {
        let (count, complaints) = play(seed, seed % 2 == 0, 3_000);
        faults += count;
        if let Some(first) = complaints.first() {
            sessions += 1;
            println!("seed {seed}: {} mistakes, first: {first}", complaints.len());
        }
    }
    println!("{faults} faults, {sessions} of 8000 sessions with a mistake");
    assert!(sessions <= 4, "{sessions} sessions");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    /// The same law for seeds that nobody chose. Once in many thousand faults two rows in sequence look like something
    /// else to any rule (seed 202418813381: a reset is announced where there was none): that must stay rare.
    #[test]
    fn faults_of_any_seed_are_told_apart(seed in 1_000u64..1 << 40, wide in any::<bool>()) {
        let (_, wrong) = play(seed, wide, 2_000);
        prop_assert!(wrong.len() <= 2, "{}: {}", wrong.len(), wrong[0]);
    }
}
