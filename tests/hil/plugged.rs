//! Cameras that run beside a test: `uvc_camera.rs` behind the kernel's USB.
#![allow(dead_code)] // one test's cameras play, the other's make their pictures up

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex};

/// A camera; dropped, it is unplugged.
pub struct Uvc {
    process: Child,
    orders: ChildStdin,
    said: Arc<Mutex<Said>>,
}

#[derive(Default)]
struct Said {
    streaming: bool,
    sent: Vec<u32>,
}

impl Uvc {
    pub fn plug(port: u32, serial: &str, format: &str, width: usize, height: usize, fps: u32) -> Uvc {
        Self::start(&[
            port.to_string(),
            serial.into(),
            format.into(),
            width.to_string(),
            height.to_string(),
            fps.to_string(),
        ])
    }

    /// Plays a file of pictures, in the format that its name ends with, at instants of another from when it is ordered to:
    /// `play NS`.
    pub fn playing(port: u32, serial: &str, (w, h): (usize, usize), fps: u32, [frames, instants]: [&Path; 2]) -> Uvc {
        let [w, h, fps, port] = [w as u32, h as u32, fps, port].map(|n| n.to_string());
        let format = frames.extension().unwrap().to_str().unwrap().to_string();
        let [frames, instants] = [frames, instants].map(|p| p.display().to_string());
        Self::start(&[port, serial.into(), format, w, h, fps, frames, instants])
    }

    fn start(arguments: &[String]) -> Uvc {
        let program = std::env::var("HIL_UVC_CAMERA").expect("set by uvc.sh and those of flights");
        let mut command = Command::new(program);
        let mut process = command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (orders, output) = (process.stdin.take().unwrap(), process.stdout.take().unwrap());
        let said: Arc<Mutex<Said>> = Arc::default();
        let log = said.clone();
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let mut said = log.lock().unwrap();
                said.streaming |= line == "streaming";
                said.sent.extend(line.strip_prefix("sent ").map(|k| k.parse::<u32>().unwrap()));
            }
        });
        Uvc { process, orders, said }
    }

    pub fn order(&mut self, order: &str) {
        writeln!(self.orders, "{order}").unwrap();
    }

    /// Whether the host ever asked it for pictures.
    pub fn is_streaming(&self) -> bool {
        self.said.lock().unwrap().streaming
    }

    /// Numbers of the pictures it sent.
    pub fn sent(&self) -> Vec<u32> {
        self.said.lock().unwrap().sent.clone()
    }

    /// Pictures it did not send between two that it sent.
    pub fn unsent(&self, from: u32, to: u32) -> u64 {
        u64::from(to - from + 1) - self.sent().iter().filter(|k| (from..=to).contains(*k)).count() as u64
    }
}

impl Drop for Uvc {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
