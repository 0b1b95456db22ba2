// SPDX-License-Identifier: MIT OR Apache-2.0
//! A real browser, driven over WebDriver (W3C): headless Chromium by `chromedriver`.

use fourdbody::control::client::NodeClient;
use hyper::Method;
use serde_json::{Value, json};
use std::cell::Cell;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A browser with one page; ended when dropped.
pub struct Browser {
    driver: Child,
    client: NodeClient,
    session: String,
    /// What [`Self::resize`] was told last.
    screen: Cell<Option<Screen>>,
}

/// Width and height, and whether it is touched.
type Screen = ((u32, u32), bool);

/// Sizes at which pictures are kept.
const SCREENS: [(&str, Screen); 4] = [
    ("phone", ((390, 844), true)),
    ("1366", ((1366, 768), false)),
    ("1920", ((1920, 1080), false)),
    ("3840", ((3840, 2160), false)),
];

/// Two busy cores share a browser, two nodes and eight cameras.
const PATIENCE: Duration = Duration::from_secs(120);

impl Browser {
    /// Starts it; `None` when there is none on this machine.
    pub fn start() -> Option<Self> {
        let mut driver = Command::new("chromedriver")
            .arg("--port=0")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .ok()?;
        let lines = BufReader::new(driver.stdout.take().expect("piped")).lines();
        let told = "ChromeDriver was started successfully on port ";
        let port = lines
            .map_while(Result::ok)
            .find_map(|line| Some(line.strip_prefix(told)?.trim_end_matches('.').to_owned()));
        let client = NodeClient::new(&format!("http://127.0.0.1:{}", port.expect("a port")));
        let mut browser = Self { driver, client, session: String::new(), screen: Cell::default() };
        // Whatever language this machine speaks: words are compared in English.
        let arguments = [
            "--headless=new",
            "--no-sandbox",
            "--enable-unsafe-swiftshader",
            "--window-size=1920,1200",
            "--accept-lang=en-US",
        ];
        let wanted =
            json!({ "capabilities": { "alwaysMatch": { "goog:chromeOptions": { "args": arguments } } } });
        let made = browser.ask(Method::POST, "/session", Some(wanted));
        browser.session = format!("/session/{}", made["sessionId"].as_str().expect("a session"));
        Some(browser)
    }

    fn ask(&self, method: Method, path: &str, body: Option<Value>) -> Value {
        let path = format!("{}{path}", self.session);
        let body = body.map(|body| body.to_string().into_bytes());
        let answer = self.client.ask(method, &path, body, PATIENCE).expect("the driver answers");
        let mut told: Value = serde_json::from_slice(&answer.body).expect("JSON");
        assert!(answer.status.is_success(), "{path}: {told}");
        told["value"].take()
    }

    /// Opens a page in the browser.
    pub fn open(&self, url: &str) {
        self.ask(Method::POST, "/url", Some(json!({ "url": url })));
    }

    /// Runs a script in the page; what it returns.
    pub fn run(&self, script: &str) -> Value {
        self.ask(Method::POST, "/execute/sync", Some(json!({ "script": script, "args": [] })))
    }

    /// The text of the element with this id.
    pub fn text(&self, id: &str) -> String {
        self.run(&format!("return document.getElementById({id:?}).textContent"))
            .as_str()
            .unwrap_or("")
            .to_owned()
    }

    /// Waits until a script returns true; with what the page says when it never does. How long it took.
    pub fn wait(&self, what: &str, script: &str) -> Duration {
        let begin = Instant::now();
        while self.run(script) != Value::Bool(true) {
            let page = || self.run("return document.body.innerText");
            assert!(begin.elapsed() < PATIENCE, "never {what}; the page:\n{}", page().as_str().unwrap_or(""));
            std::thread::sleep(Duration::from_millis(20));
        }
        begin.elapsed()
    }

    /// Waits until the verdict begins like this.
    pub fn wait_verdict(&self, word: &str) -> Duration {
        let script = "return document.getElementById('verdict-word').textContent";
        self.wait(word, &format!("{script}.startsWith({word:?})"))
    }

    /// Waits until the big word begins like this.
    pub fn wait_word(&self, word: &str) -> Duration {
        self.wait(word, &format!("return document.getElementById('word').textContent.startsWith({word:?})"))
    }

    /// Presses a key where the focus is.
    pub fn press(&self, key: &str) {
        let actions = json!([{ "type": "keyDown", "value": key }, { "type": "keyUp", "value": key }]);
        let keyboard = json!([{ "type": "key", "id": "keyboard", "actions": actions }]);
        self.ask(Method::POST, "/actions", Some(json!({ "actions": keyboard })));
    }

    /// Types into the focused field.
    pub fn type_in(&self, id: &str, text: &str) {
        self.run(&format!("const field = document.getElementById({id:?}); field.focus(); field.value = ''"));
        text.chars().for_each(|key| self.press(&key.to_string()));
        self.run("document.activeElement.blur()");
    }

    /// Clicks so far from the middle of an element.
    pub fn click(&self, id: &str, (x, y): (i32, i32)) {
        self.mouse(id, (x, y), (0, 0));
    }

    /// Drags the mouse over an element, from its middle.
    pub fn drag(&self, id: &str, by: (i32, i32)) {
        self.mouse(id, (0, 0), by);
    }

    fn mouse(&self, id: &str, from: (i32, i32), by: (i32, i32)) {
        let find = json!({ "using": "css selector", "value": format!("#{id}") });
        let element = self.ask(Method::POST, "/element", Some(find));
        let actions = json!([
            { "type": "pointerMove", "origin": element, "x": from.0, "y": from.1, "duration": 0 },
            { "type": "pointerDown", "button": 0 },
            { "type": "pointerMove", "origin": "pointer", "x": by.0, "y": by.1, "duration": 100 },
            { "type": "pointerUp", "button": 0 },
        ]);
        let mouse = json!([{ "type": "pointer", "id": "mouse", "actions": actions }]);
        self.ask(Method::POST, "/actions", Some(json!({ "actions": mouse })));
    }

    /// Speaks to the browser itself (Chrome DevTools Protocol).
    fn tell(&self, command: &str, parameters: Value) {
        let body = json!({ "cmd": command, "params": parameters });
        self.ask(Method::POST, "/goog/cdp/execute", Some(body));
    }

    /// Gives the page exactly this many pixels; `phone` is a screen that is touched.
    pub fn resize(&self, (width, height): (u32, u32), phone: bool) {
        self.screen.set(Some(((width, height), phone)));
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone });
        self.tell("Emulation.setDeviceMetricsOverride", metrics);
    }

    /// Has the page know that its reader wants nothing to move.
    pub fn reduce_motion(&self) {
        let feature = json!({ "name": "prefers-reduced-motion", "value": "reduce" });
        self.tell("Emulation.setEmulatedMedia", json!({ "features": [feature] }));
    }

    /// Waits until this element's text contains something.
    pub fn wait_text(&self, id: &str, part: &str) -> Duration {
        let script = format!("return document.getElementById({id:?}).textContent.includes({part:?})");
        self.wait(&format!("{part:?} in {id}"), &script)
    }

    /// Left, top, width and height of an element on the screen.
    pub fn place(&self, id: &str) -> Value {
        self.run(&format!(
            "const r = document.getElementById({id:?}).getBoundingClientRect(); return [r.x, r.y, r.width, r.height]"
        ))
    }

    /// Keeps pictures of the page at four sizes, where FOURDBODY_SCREENSHOTS names a directory.
    pub fn keep(&self, name: &str) {
        let Some(dir) = std::env::var_os("FOURDBODY_SCREENSHOTS") else { return };
        let before = self.screen.get();
        for (kind, (size, phone)) in SCREENS {
            self.resize(size, phone);
            // Canvases are drawn anew.
            std::thread::sleep(Duration::from_millis(150));
            let picture = self.ask(Method::GET, "/screenshot", None);
            let path = Path::new(&dir).join(format!("{name}-{kind}.png.base64"));
            std::fs::write(path, picture.as_str().unwrap_or("")).expect("writable");
        }
        match before {
            Some((size, phone)) => self.resize(size, phone),
            None => self.tell("Emulation.clearDeviceMetricsOverride", json!({})),
        }
        self.screen.set(before);
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The driver takes the browser with it.
        let quit = self.client.ask(Method::DELETE, &self.session, None, Duration::from_secs(10));
        drop(quit);
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}
