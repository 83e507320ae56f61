//! A headless Chromium, controlled by the Chrome DevTools Protocol over a WebSocket.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tungstenite::{Message, WebSocket};

/// Maximum wait; pages are slow if several programs share the machine.
const PATIENCE: Duration = Duration::from_secs(60);

pub struct Browser {
    child: Child,
    socket: WebSocket<TcpStream>,
    next: u64,
    /// Events of the tabs that asked for them ([`Browser::listen`]), in order.
    events: Vec<Value>,
    _profile: tempfile::TempDir,
}

/// A browser tab.
#[derive(Clone)]
pub struct Tab {
    session: String,
}

impl Browser {
    /// Starts a browser; the error says why there is none.
    pub fn start() -> Result<Self, String> {
        let profile = tempfile::tempdir().map_err(|error| error.to_string())?;
        let program = ["chromium", "chromium-browser", "google-chrome"]
            .into_iter()
            .find(|name| Command::new(name).arg("--version").output().is_ok_and(|done| done.status.success()))
            .ok_or("there is no chromium on this machine")?;
        let mut child = Command::new(program)
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-quic",
                "--no-first-run",
                "--hide-scrollbars",
            ])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
            .args(["--remote-debugging-port=0", "--remote-allow-origins=*"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| format!("{program} cannot be started: {error}"))?;
        let mut lines = BufReader::new(child.stderr.take().ok_or("no standard error")?).lines();
        let address = lines
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| line.strip_prefix("DevTools listening on ").map(str::to_owned))
            .ok_or("chromium ended before it listened")?;
        // Later output is ignored, but its pipe must be drained.
        std::thread::spawn(move || lines.for_each(drop));
        let host = address.trim_start_matches("ws://").split('/').next().unwrap_or_default().to_owned();
        let stream = TcpStream::connect(host).map_err(|error| error.to_string())?;
        stream.set_read_timeout(Some(PATIENCE)).map_err(|error| error.to_string())?;
        let (socket, _) = tungstenite::client(address, stream).map_err(|error| error.to_string())?;
        Ok(Self { child, socket, next: 0, events: Vec::new(), _profile: profile })
    }

    fn call(&mut self, session: Option<&str>, method: &str, parameters: Value) -> Value {
        self.next += 1;
        let id = self.next;
        let mut call = json!({ "id": id, "method": method, "params": parameters });
        if let Some(session) = session {
            call["sessionId"] = json!(session);
        }
        self.socket.send(Message::text(call.to_string())).unwrap();
        loop {
            // Events arrive between responses.
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(&text).unwrap();
            if answer["id"] == json!(id) {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].clone();
            }
            if answer["method"].is_string() {
                self.events.push(answer);
            }
        }
    }

    /// Opens a page in a new tab of a given size, in light or dark mode.
    pub fn open(&mut self, url: &str, size: (u32, u32), dark: bool) -> Tab {
        let tab = self.tab(size, dark);
        self.go(&tab, url);
        tab
    }

    /// Goes to a page.
    pub fn go(&mut self, tab: &Tab, url: &str) {
        self.call(Some(&tab.session), "Page.navigate", json!({ "url": url }));
    }

    /// Keeps what is logged and requested in a tab from here on.
    pub fn listen(&mut self, tab: &Tab) {
        for domain in ["Log", "Runtime", "Network"] {
            self.call(Some(&tab.session), &format!("{domain}.enable"), json!({}));
        }
    }

    /// What was written to the console or logged as an error, and the exceptions that nothing
    /// caught.
    pub fn complaints(&self) -> Vec<String> {
        let told = ["Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown"];
        let told = self.events.iter().filter(|event| told.iter().any(|name| event["method"] == *name));
        told.map(|event| event["params"].to_string()).collect()
    }

    /// The addresses that were requested.
    pub fn requests(&self) -> Vec<String> {
        let requests = self.events.iter().filter(|event| event["method"] == "Network.requestWillBeSent");
        requests.filter_map(|event| Some(event["params"]["request"]["url"].as_str()?.to_owned())).collect()
    }

    /// Chooses the file of an input element.
    pub fn choose_file(&mut self, tab: &Tab, selector: &str, file: &Path) {
        let session = Some(&*tab.session);
        let root = self.call(session, "DOM.getDocument", json!({}))["root"]["nodeId"].clone();
        let found = self.call(session, "DOM.querySelector", json!({ "nodeId": root, "selector": selector }));
        let chosen = json!({ "nodeId": found["nodeId"], "files": [file] });
        self.call(session, "DOM.setFileInputFiles", chosen);
    }

    /// Saves downloads in a folder.
    pub fn download_into(&mut self, folder: &Path) {
        let behavior = json!({ "behavior": "allow", "downloadPath": folder });
        self.call(None, "Browser.setDownloadBehavior", behavior);
    }

    /// An empty tab of a given size, in light or dark mode.
    pub fn tab(&mut self, size: (u32, u32), dark: bool) -> Tab {
        let target = self.call(None, "Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let session =
            self.call(None, "Target.attachToTarget", attach)["sessionId"].as_str().unwrap().to_owned();
        let tab = Tab { session };
        self.look(&tab, size, dark);
        // Key events reach only a focused page.
        self.call(Some(&tab.session), "Emulation.setFocusEmulationEnabled", json!({ "enabled": true }));
        tab
    }

    /// Sets the size of a tab, and light or dark mode.
    pub fn look(&mut self, tab: &Tab, (width, height): (u32, u32), dark: bool) {
        let metrics =
            json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600 });
        self.call(Some(&tab.session), "Emulation.setDeviceMetricsOverride", metrics);
        let scheme = if dark { "dark" } else { "light" };
        let features = json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }] });
        self.call(Some(&tab.session), "Emulation.setEmulatedMedia", features);
    }

    /// The value of an expression on the page.
    pub fn evaluate(&mut self, tab: &Tab, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let result = self.call(Some(&tab.session), "Runtime.evaluate", parameters);
        assert!(result["exceptionDetails"].is_null(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn wait(&mut self, tab: &Tab, expression: &str) {
        // A browser draws only the foreground tab.
        self.call(Some(&tab.session), "Page.bringToFront", json!({}));
        let until = Instant::now() + PATIENCE;
        while self.evaluate(tab, &format!("Boolean(document.body && ({expression}))")) != json!(true) {
            if Instant::now() > until {
                let page =
                    self.evaluate(tab, "JSON.stringify(document.body.dataset) + document.body.innerText");
                panic!("it did not become true that {expression}: {page}");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Presses a key.
    pub fn press(&mut self, tab: &Tab, key: &str) {
        for kind in ["keyDown", "keyUp"] {
            let event = json!({ "type": kind, "key": key, "text": if kind == "keyDown" { key } else { "" } });
            self.call(Some(&tab.session), "Input.dispatchKeyEvent", event);
        }
    }

    /// Saves a screenshot if `ODOGRAPH_SCREENSHOTS` names a folder, for inspection.
    pub fn picture(&mut self, tab: &Tab, name: &str) {
        let Some(folder) = std::env::var_os("ODOGRAPH_SCREENSHOTS") else { return };
        self.call(Some(&tab.session), "Page.bringToFront", json!({}));
        let shot = self.call(Some(&tab.session), "Page.captureScreenshot", json!({ "format": "png" }));
        let path = Path::new(&folder).join(format!("{name}.png"));
        std::fs::write(path, base64(shot["data"].as_str().unwrap())).unwrap();
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Decodes Base64.
fn base64(text: &str) -> Vec<u8> {
    let value = |byte: u8| match byte {
        b'A'..=b'Z' => u32::from(byte - b'A'),
        b'a'..=b'z' => u32::from(byte - b'a') + 26,
        b'0'..=b'9' => u32::from(byte - b'0') + 52,
        b'+' => 62,
        _ => 63,
    };
    let digits: Vec<u8> = text.bytes().filter(|byte| *byte != b'=').collect();
    let group = |group: &[u8]| {
        let word = group.iter().fold(0, |word, digit| word << 6 | value(*digit)) << (6 * (4 - group.len()));
        [(word >> 16) as u8, (word >> 8) as u8, word as u8]
            .into_iter()
            .take(group.len() - 1)
            .collect::<Vec<_>>()
    };
    digits.chunks(4).flat_map(group).collect()
}
