// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the console says is so: in a real browser, before real nodes whose devices and processes fail. Two minutes on two
//! busy cores.

use crate::browser::Browser;
use crate::lab::{NodeProcess, SIZE, options, small_rig, start, start_nodes};
use crate::session_faults::signal;
use fourdbody_simulator::laboratory::Laboratory;
use serde_json::Value;
use std::path::Path;

const RATE_HZ: f64 = 20.0;

/// Eight small cameras, a train that warms up for two seconds, nodes that trust this machine, and a page of the first.
struct Scene {
    dir: tempfile::TempDir,
    laboratory: Laboratory,
    nodes: Vec<NodeProcess>,
    browser: Browser,
}

impl Scene {
    /// `None` without a browser on this machine.
    fn open() -> Option<Self> {
        let Some(browser) = Browser::start() else {
            println!("skipped: no browser (Debian packages chromium and chromium-driver)");
            return None;
        };
        let dir = tempfile::tempdir().expect("a temporary directory");
        let rig = small_rig(RATE_HZ).replace("warm_up_triggers = 8 ", "warm_up_triggers = 40 ");
        assert!(rig.contains("warm_up_triggers = 40"), "the shipped rig says it in other words");
        let laboratory = start(&options(rig, dir.path()), SIZE);
        let nodes = start_nodes(&laboratory);
        let scene = Self { dir, laboratory, nodes, browser };
        scene.load();
        Some(scene)
    }

    fn load(&self) {
        self.browser.open(&self.url(""));
        self.browser.wait_word("READY");
    }

    fn url(&self, page: &str) -> String {
        format!("http://127.0.0.1:{}/{page}", self.laboratory.nodes[0].port)
    }

    /// Fills the form: name, seconds, takes, countdown.
    fn fill(&self, name: &str, seconds: &str, takes: &str, countdown: &str) {
        for (field, value) in
            [("name", name), ("seconds", seconds), ("takes", takes), ("countdown", countdown)]
        {
            self.browser.type_in(field, value);
        }
    }

    /// What the first node answers.
    fn asked(&self, path: &str) -> Value {
        self.nodes[0].client.get(path).expect("an answer")
    }

    /// Waits until the capture that the first node runs is where this is true.
    fn wait_capture(&self, what: &str, holds: impl Fn(&Value) -> bool) {
        let deadline = std::time::Instant::now() + std::time::Duration::from_secs(90);
        while !holds(&self.asked("/api/v1/capture")) {
            assert!(std::time::Instant::now() < deadline, "never {what}");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
    }
}

#[test]
fn an_edge_of_an_input_begins_a_session_and_stop_ends_the_waiting() {
    let Some(mut scene) = Scene::open() else { return };
    let begin = |scene: &Scene, name: &str| {
        scene.fill(name, "0.5", "1", "0");
        scene.browser.run("document.getElementById('start-on').value = '2:rising'");
        scene.browser.press("r");
        scene.browser.wait_word("WAITING");
        scene.browser.wait_text("detail", "input 2 of the HSU must go on");
    };
    begin(&scene, "never");
    scene.browser.keep("awaiting-edge");
    for size in [(1366, 768), (1920, 1080)] {
        scene.browser.resize(size, false);
        let whole =
            "const word = document.getElementById('word'); return word.scrollWidth <= word.clientWidth";
        scene.browser.wait("the longest word is seen whole", whole);
    }
    scene.browser.press("s");
    scene.browser.wait_verdict("STOPPED");
    scene.browser.wait_text("verdict-detail", "before the edge came");
    scene.nodes.iter_mut().for_each(|node| drop(node.wait_idle()));
    scene.browser.wait_word("READY");
    assert!(!scene.dir.path().join("sessions/never").exists());
    begin(&scene, "begun");
    scene.laboratory.hsu.input(2, true);
    scene.browser.wait_verdict("COMPLETE");
    assert!(scene.dir.path().join("sessions/begun").exists());
}

#[test]
fn a_series_is_told_with_all_its_takes() {
    let Some(mut scene) = Scene::open() else { return };
    two_takes_are_two_takes(&scene);
    a_name_that_is_taken_is_numbered(&scene);
    the_first_take_has_its_causes(&mut scene);
    a_stop_in_the_warm_up_of_take_two_fails_nothing(&scene);
    what_is_thought_of_a_take_is_kept(&scene);
    seconds_before_record_are_kept(&scene);
}

/// The first press holds, the second records: the take begins a second before it.
fn seconds_before_record_are_kept(scene: &Scene) {
    let browser = &scene.browser;
    scene.fill("jump", "1", "1", "0");
    browser.type_in("before", "1");
    browser.wait(
        "the button says what it does",
        "return document.getElementById('start').innerText.startsWith('Hold')",
    );
    browser.press("r");
    browser.wait_word("STANDBY");
    browser.keep("holding");
    browser
        .wait("a second is held", "return document.getElementById('clock').textContent === '1.0 of 1.0 s'");
    assert!(!browser.text("session-rows").contains("jump"), "what is only held is no take");
    browser.wait("and can be kept", "return !document.getElementById('start').disabled");
    assert_eq!(browser.text("start-word"), "Record");
    browser.press("r");
    browser.wait_verdict("COMPLETE");
    let triggers = scene.asked("/api/v1/status")["session"]["triggers"].as_u64().expect("a number");
    assert!(triggers >= 40, "{triggers} triggers: a second before Record and one behind it");
    browser.type_in("before", "");
}

fn two_takes_are_two_takes(scene: &Scene) {
    let browser = &scene.browser;
    scene.fill("walk", "2", "2", "1");
    browser.type_in("subject", "p07");
    browser.press("r");
    browser.wait_word("RECORDING");
    browser.wait_verdict("COMPLETE");
    let detail = browser.text("verdict-detail");
    assert!(detail.contains("2 of 2 takes, 640 of 640 frames") && detail.contains("walk-02"), "{detail}");
    browser.wait(
        "a time line to the end of the take",
        "return document.getElementById('line-canvas').ariaLabel.includes('trigger 40 of 40')",
    );
    let sounds: Value =
        serde_json::from_str(browser.run("return document.body.dataset.sounds").as_str().expect("text"))
            .expect("JSON");
    // A second of the countdown has no tick where the busy page had no answer of the node within it.
    assert!(matches!(sounds["tick"].as_u64(), Some(1..=2)), "{sounds}");
    assert_eq!((&sounds["start"], &sounds["loss"]), (&2.into(), &Value::Null), "{sounds}");
}

fn a_name_that_is_taken_is_numbered(scene: &Scene) {
    let browser = &scene.browser;
    browser.type_in("subject", "");
    scene.fill("walk-01", "0.5", "1", "0");
    browser.press("r");
    browser.wait_text("verdict-detail", "walk-03");
    assert_eq!(browser.text("verdict-word"), "COMPLETE");
    assert!(scene.dir.path().join("sessions/walk-03/node-b").is_dir());
}

/// A camera is away for a part of the first of two takes; the second one is whole.
fn the_first_take_has_its_causes(scene: &mut Scene) {
    scene.fill("hole", "7", "2", "0");
    scene.browser.press("r");
    scene.browser.wait("triggers", "return parseFloat(document.getElementById('clock').textContent) > 0.3");
    scene.laboratory.unplug(3);
    scene.browser.wait(
        "told of the loss",
        "return document.getElementById('verdict-word').textContent.endsWith('LOST')",
    );
    // The page counts what a silent camera owes: the gap records come when the camera is known to be lost.
    let recorded = |status: &Value| -> u64 {
        let cameras = status["session"]["cameras"].as_array().into_iter().flatten();
        cameras.filter_map(|camera| camera["gaps"].as_u64()).sum()
    };
    let before = recorded(&scene.asked("/api/v1/status"));
    let told = scene.browser.text("verdict-word");
    println!("the page said {told} when the node had {before} gap records");
    assert!(told.trim_end_matches(" LOST").parse::<u64>().expect("a number") > before, "{told} and {before}");
    assert!(scene.browser.text("verdict-detail").contains("h1_low"), "the camera is named");
    scene.laboratory.plug(3).expect("the camera starts");
    scene.browser.wait_verdict("INCOMPLETE");
    let detail = scene.browser.text("verdict-detail");
    assert!(detail.contains("2 of 2 takes"), "{detail}");
    assert!(
        detail.contains("hole-01 INCOMPLETE: node a: h1_low") && !detail.contains("hole-02 INCOMPLETE"),
        "{detail}"
    );
    assert!(scene.browser.text("line-lost").parse::<u64>().is_ok());
}

fn a_stop_in_the_warm_up_of_take_two_fails_nothing(scene: &Scene) {
    scene.fill("pair", "0.5", "2", "0");
    scene.browser.press("r");
    scene.wait_capture("in the warm-up of take 2", |capture| {
        capture["take"] == 2 && capture["stage"]["stage"] == "recording" && capture["stage"]["triggers"] == 0
    });
    scene.browser.press("s");
    scene.browser.wait_text("verdict-detail", "take 2 of 2");
    assert_eq!(scene.browser.text("verdict-word"), "COMPLETE", "{}", scene.browser.text("verdict-detail"));
    assert!(scene.browser.text("verdict-detail").contains("80 of 80 frames"));
    scene.browser.wait_word("READY");
}

fn what_is_thought_of_a_take_is_kept(scene: &Scene) {
    let browser = &scene.browser;
    browser.wait("listed", "return document.getElementById('session-rows').innerText.includes('pair-01')");
    browser.run(
        "const row = document.querySelector('[data-name=\"pair-01\"]');
         row.querySelector('[aria-label=\"rate pair-01: Unsure\"]').click();
         const note = row.querySelector('input');
         note.value = 'left arm hides the side';
         note.dispatchEvent(new Event('change'))",
    );
    let kept = scene.dir.path().join("sessions/pair-01/remark-b.json");
    browser.wait(
        "kept on both nodes",
        "return document.querySelector('[data-name=\"pair-01\"] [aria-pressed=\"true\"]') !== null",
    );
    let deadline = std::time::Instant::now() + std::time::Duration::from_secs(30);
    while !std::fs::read_to_string(&kept)
        .is_ok_and(|text| text.contains("left arm") && text.contains("doubtful"))
    {
        assert!(std::time::Instant::now() < deadline, "{}", kept.display());
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    scene.load();
    for (search, there, absent) in
        [("LEFT arm", "pair-01", "walk-01"), ("p07", "walk-01", "pair-01"), ("hole", "hole-02", "walk")]
    {
        browser.type_in("search", search);
        browser.run("document.getElementById('search').dispatchEvent(new Event('input'))");
        browser.wait(
            &format!("{search:?} finds {there} alone"),
            &format!("const rows = document.getElementById('session-rows').innerText; return rows.includes({there:?}) && !rows.includes({absent:?})"),
        );
    }
    browser.type_in("search", "pair-01");
    let pressed = "return document.querySelector('[data-name=\"pair-01\"] [aria-pressed=\"true\"]')?.textContent === 'Unsure'";
    browser.wait("the rating came back", pressed);
}

#[test]
fn nothing_old_is_shown_as_new() {
    let Some(mut scene) = Scene::open() else { return };
    let live = "return document.querySelectorAll('.camera.live').length === 8";
    scene.browser.wait("eight live pictures", live);
    a_node_that_stands_still_is_late_before_it_is_gone(&scene);
    a_node_is_killed(&mut scene);
    scene.fill("whole", "0.5", "1", "0");
    scene.browser.press("r");
    scene.browser.wait_verdict("COMPLETE");
    // Everything dies while nobody records.
    (0..8).for_each(|camera| scene.laboratory.unplug(camera));
    scene.laboratory.hsu.set_unresponsive(true);
    let took = scene.browser.wait_word("NOT READY");
    println!("the page was NOT READY {} ms after all devices had died", took.as_millis());
    assert_eq!(
        scene.browser.text("verdict-word"),
        "COMPLETE",
        "the verdict is still that of the last session"
    );
    scene.browser.wait(
        "no camera of the first node is called good",
        "return /^a 0 of 4/.test(document.getElementById('devices').textContent)",
    );
    assert_eq!(scene.browser.run("return document.getElementById('start').disabled"), true);
    scene.browser.keep("all-dead");
}

fn a_node_that_stands_still_is_late_before_it_is_gone(scene: &Scene) {
    let (browser, node) = (&scene.browser, &scene.nodes[0]);
    signal(node, libc::SIGSTOP);
    browser.wait_word("NO NEWS");
    assert_eq!(browser.run("return document.getElementById('state').className"), "", "grey, not red");
    browser.wait_word("NO ANSWER");
    signal(node, libc::SIGCONT);
    browser.wait_word("READY");
}

fn a_node_is_killed(scene: &mut Scene) {
    scene.nodes[1].kill();
    let browser = &scene.browser;
    browser.wait_word("NOT READY");
    let dead = "const b = [...document.querySelectorAll('.camera')].filter((box) => /^camera-h[23]/.test(box.id));
        return b.length === 4 && b.every((box) => box.classList.contains('bad') && box.classList.contains('old') &&
            /\\d (s|min)$/.test(box.querySelector('.age').textContent) && box.innerText.includes('no status from node b'))";
    browser.wait("the dead node's pictures are old", dead);
    browser.wait(
        "its age grows",
        "return / [2-9]\\d* s/.test(document.querySelector('#camera-h2_up .said').textContent)",
    );
    assert!(browser.text("why").contains("node b does not answer"), "{}", browser.text("why"));
    browser.press("r");
    assert_eq!(scene.asked("/api/v1/capture"), Value::Null, "nothing was begun");
    browser.keep("node-b-killed");
    let node = &scene.laboratory.nodes[1];
    scene.nodes[1] = NodeProcess::start(&node.path, node.port);
    scene.nodes[1].wait_ready();
    scene.browser.wait_word("READY");
}

#[test]
fn the_page_is_seen_whole_and_nothing_moves_under_the_hand() {
    let Some(scene) = Scene::open() else { return };
    let browser = &scene.browser;
    scene.fill("first", "0.5", "1", "0");
    browser.press("r");
    browser.wait_verdict("COMPLETE");
    many_sessions(scene.dir.path());
    browser
        .wait("29 sessions listed", "return document.querySelectorAll('#session-rows > li').length === 29");
    scene.fill("again", "", "1", "0");
    for (name, size, figure) in
        [("3840", (3840, 2160), 50.0), ("1920", (1920, 1080), 25.0), ("1366", (1366, 768), 19.0)]
    {
        browser.resize(size, false);
        let before = (browser.place("stop"), browser.place("start"));
        seen_whole(browser, size, figure, 4);
        let preview =
            browser.run("return getComputedStyle(document.getElementById('state')).backgroundColor");
        browser.wait("eight live pictures", "return document.querySelectorAll('.camera.live').length === 8");
        readable(browser);
        browser.keep("ready");
        assert_eq!((browser.place("stop"), browser.place("start")), before, "{name}");
        read_from_three_metres(browser, size);
        browser.press("r");
        browser.wait_word("RECORDING");
        let recording =
            browser.run("return getComputedStyle(document.getElementById('state')).backgroundColor");
        assert_ne!(preview, recording, "what is recorded looks like nothing else");
        browser
            .wait("a time line", "return Number(document.getElementById('line-canvas').dataset.samples) > 2");
        readable(browser);
        seen_whole(browser, size, figure, 4);
        browser.keep("recording");
        // Whatever there is to say: the hand finds Stop where it was.
        browser.run("document.getElementById('detail').textContent = 'cause\\n'.repeat(50);
            document.getElementById('verdict-detail').textContent = 'cause\\n'.repeat(50); document.getElementById('why').textContent = 'why '.repeat(200)");
        assert_eq!((browser.place("stop"), browser.place("start")), before, "{name}");
        abort_is_asked(browser);
        assert_eq!((browser.place("stop"), browser.place("start")), before, "{name}");
        readable(browser);
        browser.keep("aborted");
    }
    ready_means_that_record_would_start(&scene);
    in_german(browser);
    on_a_phone(browser);
    browser.reduce_motion();
    browser.press("r");
    browser.wait_word("RECORDING");
    assert_eq!(browser.run("return document.getAnimations().length"), 0, "nothing moves for who wants that");
    browser.press("s");
    browser.wait_verdict("COMPLETE");
    the_subject_is_told(&scene);
}

/// As many sessions as a morning has.
fn many_sessions(dir: &Path) {
    let first = dir.join("sessions/first");
    for number in 2..=29 {
        let copy = dir.join(format!("sessions/walk-{number:02}"));
        for node in ["node-a", "node-b"] {
            std::fs::create_dir_all(copy.join(node)).expect("writable");
            for file in std::fs::read_dir(first.join(node)).expect("recorded").flatten() {
                std::fs::copy(file.path(), copy.join(node).join(file.file_name())).expect("writable");
            }
        }
    }
}

/// All tiles, the buttons, the time line and the quick look (or its tab) are on the screen without scrolling.
fn seen_whole(browser: &Browser, (width, height): (u32, u32), figure: f64, takes_at_1080: u64) {
    // Whatever the form asks for, the newest takes are seen whole: four of them on a screen of 1080 lines.
    let takes = "const list = document.getElementById('session-rows').getBoundingClientRect();
        return [...document.querySelectorAll('#session-rows > li')].filter((li) => li.getBoundingClientRect().bottom <= list.bottom).length";
    let takes = browser.run(takes).as_u64().unwrap_or(0);
    assert!(
        takes >= if height >= 1080 { takes_at_1080 } else { 1 },
        "{takes} takes are seen at {width} x {height}"
    );
    let script = "
        const inside = (element) => { const r = element.getBoundingClientRect();
            return r.width > 0 && r.height > 0 && r.left >= 0 && r.top >= 0 && r.right <= innerWidth && r.bottom <= innerHeight; };
        const all = [...document.querySelectorAll('.camera'), ...document.querySelectorAll('.buttons button'), document.getElementById('line'),
            document.getElementById('word'), document.getElementById('search')];
        const figures = [...document.querySelectorAll('.camera .sign')].map((sign) => parseFloat(getComputedStyle(sign).fontSize));
        const cut = [...document.querySelectorAll('#word, #verdict-word, #clock, .camera .name, .numbers label')].filter((e) => e.textContent && (e.scrollWidth > e.clientWidth + 1 || e.clientHeight < 0.9 * parseFloat(getComputedStyle(e).fontSize)));
        const stage = document.getElementById('state').getBoundingClientRect(), clock = document.getElementById('clock').getBoundingClientRect();
        if (clock.height && clock.bottom > stage.bottom) cut.push(document.getElementById('clock'));
        return JSON.stringify({ tiles: document.querySelectorAll('.camera').length, outside: all.filter((e) => !inside(e)).map((e) => e.id || e.className),
            look: inside(document.getElementById('body')), scrolls: document.documentElement.scrollHeight > innerHeight, figure: Math.min(...figures), cut: cut.map((e) => e.textContent) })";
    let seen: Value = serde_json::from_str(browser.run(script).as_str().expect("text")).expect("JSON");
    let what = format!("{width} x {height}: {seen}");
    assert_eq!(
        (&seen["tiles"], &seen["scrolls"], &seen["look"]),
        (&8.into(), &false.into(), &true.into()),
        "{what}"
    );
    assert_eq!((&seen["outside"], &seen["cut"]), (&serde_json::json!([]), &serde_json::json!([])), "{what}");
    assert!(seen["figure"].as_f64().expect("a number") >= figure, "{what}");
}

/// Capitals of state, verdict and cause, in minutes of arc on a screen of 24 inches, seen from three metres. Five minutes
/// are the least that a healthy eye reads.
fn read_from_three_metres(browser: &Browser, (width, height): (u32, u32)) {
    const CAPITAL_OF_FONT: f64 = 0.729;
    let pixel_mm = 24.0 * 25.4 / f64::from(width).hypot(f64::from(height));
    let minutes = |id: &str, part: &str| {
        let script = format!(
            "return parseFloat(getComputedStyle(document.getElementById({id:?}), {part:?}).fontSize)"
        );
        let capital_mm = browser.run(&script).as_f64().expect("a size") * CAPITAL_OF_FONT * pixel_mm;
        (capital_mm / 3000.0).atan().to_degrees() * 60.0
    };
    let [word, clock, cause] =
        [("word", ""), ("clock", ""), ("detail", "::first-line")].map(|(id, part)| minutes(id, part));
    println!("{width} x {height}: state {word:.1}, clock {clock:.1}, cause {cause:.1} minutes of arc");
    assert!(word > 20.0 && clock > 9.0 && cause > 9.0, "{word} {clock} {cause} at {width} x {height}");
}

/// Contrast of every text that is shown, but for what cannot be used now: 7 : 1 and more (WCAG 2.2, AAA).
fn readable(browser: &Browser) {
    let script = "
        const parse = (colour) => (colour.match(/[\\d.]+/g) ?? []).map(Number);
        const luminance = ([r, g, b]) => { const f = (x) => (x /= 255) <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
            return 0.2126 * f(r) + 0.7152 * f(g) + 0.0722 * f(b); };
        const ground = (element) => { for (let e = element; e; e = e.parentElement) { const c = parse(getComputedStyle(e).backgroundColor);
            if (c.length === 3 || c[3] > 0.5) return c; } return [6, 8, 10]; };
        const low = [];
        for (const element of document.querySelectorAll('main *')) {
            const own = [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
            if (!own || element.closest(':disabled, dialog:not([open])') || !element.getClientRects().length) continue;
            const [a, b] = [luminance(parse(getComputedStyle(element).color)), luminance(ground(element))].sort((x, y) => y - x);
            const ratio = (a + 0.05) / (b + 0.05);
            if (ratio < 7) low.push(`${element.id || element.className || element.tagName}: ${ratio.toFixed(1)}`);
        }
        return low.join(', ')";
    assert_eq!(browser.run(script), "", "hard to read");
}

/// The key asks; anything but a yes goes on.
fn abort_is_asked(browser: &Browser) {
    let open = "return document.getElementById('abort-question').open";
    browser.press("a");
    assert_eq!(browser.run(open), true);
    browser.keep("abort");
    browser.press("\u{E00C}");
    assert_eq!(browser.run(open), false, "Escape");
    browser.wait_word("RECORDING");
    browser.press("a");
    browser.press("y");
    browser.wait_verdict("ABORTED");
    browser.wait_word("READY");
}

/// A day of takes does not fit onto the disk; what needs no disk can be done.
fn ready_means_that_record_would_start(scene: &Scene) {
    let browser = &scene.browser;
    scene.fill("again", "86400", "99", "0");
    browser.wait_word("NOT READY");
    browser.wait_text("detail", "has room for");
    let enabled = "return ['start', 'dry', 'look'].map((id) => !document.getElementById(id).disabled).join()";
    assert_eq!(browser.run(enabled), "false,true,true");
    scene.fill("again", "", "1", "0");
    browser.wait_word("READY");
}

/// Another language is as whole; its words are longer.
fn in_german(browser: &Browser) {
    let choose = |tag: &str| {
        browser.run(&format!(
            "const choice = document.getElementById('language'); choice.value = {tag:?}; choice.dispatchEvent(new Event('change'))"
        ));
    };
    choose("de");
    browser.wait_word("BEREIT");
    for (size, figure) in [((1920, 1080), 25.0), ((1366, 768), 19.0)] {
        browser.resize(size, false);
        // A row of these words has a line more.
        seen_whole(browser, size, figure, 2);
        readable(browser);
    }
    browser.keep("german");
    choose("en");
    browser.wait_word("READY");
}

fn on_a_phone(browser: &Browser) {
    browser.resize((390, 844), true);
    let whole = |what: &str| {
        let script = "
            const broken = ['word', 'verdict-word'].filter((id) => { const e = document.getElementById(id);
                return e.textContent && (e.getClientRects()[0].height > 1.6 * parseFloat(getComputedStyle(e).fontSize) || e.scrollWidth > e.clientWidth + 1); });
            const stop = document.getElementById('stop').getBoundingClientRect();
            return JSON.stringify([document.documentElement.scrollWidth <= innerWidth, broken, stop.bottom <= innerHeight])";
        assert_eq!(browser.run(script), "[true,[],true]", "{what}");
        readable(browser);
    };
    whole("ready");
    let longest =
        "for (const id of ['word', 'verdict-word']) document.getElementById(id).textContent = 'UNCONFIRMED'";
    browser.run(longest);
    browser.resize((390, 844), true);
    browser.resize((1366, 768), false);
}

/// A screen of their own: the countdown, hold still, done.
fn the_subject_is_told(scene: &Scene) {
    let browser = &scene.browser;
    browser.open(&scene.url("subject.html"));
    browser.wait_word("PLEASE WAIT");
    let wish = serde_json::json!({ "wish": { "name": "told", "duration_s": 1.5, "countdown_s": 3 }, "number": true });
    let begun = scene.nodes[0].client.post("/api/v1/capture", &wish, std::time::Duration::from_secs(30));
    begun.expect("it begins");
    browser.wait("a countdown", "return /^[123]$/.test(document.getElementById('word').textContent)");
    browser.keep("subject-countdown");
    browser.wait_word("HOLD STILL");
    browser.keep("subject-hold");
    browser.wait_word("DONE");
    browser.keep("subject-done");
}
