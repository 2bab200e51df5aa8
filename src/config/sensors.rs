//! The sensors of a live run, and how they are wired: `[rig]`, `[camera]`, `[imu]`, `[baro]`, `[gpio]`, `[record]`, `[log]`.
//! Replays read `rig.readout_s`, `rig.masks`, `camera.pair_tolerance_s`, `[baro]` and `[log]` alone.

use super::section::{section, Bound};
use serde::Deserialize;
use std::collections::BTreeMap;
use stipple_drivers::baro::BaroOptions;
use stipple_drivers::calibration::{Mask, MASKS_MAX};
use stipple_drivers::gpio::{Edge, LineName};
use stipple_drivers::imu::chips::Chip;
use stipple_drivers::imu::{IioOptions, ImuOptions, RegisterOptions, Wiring};
use stipple_drivers::source::frozen_readings;
use stipple_drivers::v4l2::{Format, Select, Settings, StampPoint};
use stipple_drivers::{Calibration, Fault, FaultKind, Span};

section! {
    /// What the board knows of its sensors and their calibration does not say.
    RigConfig, "rig.";
    /// Calibration of the board's own sensors, a path from the board file's folder: Kalibr's camchain.yaml with
    /// imu_config.yaml beside it, Basalt's json, or the mav0 of a recording. A live run needs it.
    calibration: String = String::new();
    /// Rolling shutter: time from the first row to the last; 0: as the calibration says. State it where the calibration says
    /// `shutter: rolling` and no time. Above a tenth of a second the body's motion between rows is no longer of first order.
    readout_s: f64 = 0.0, Bound::Within(0.0, 0.1);
    /// Parts of the vehicle in view, which neither tracker nor map looks at, as [camera, left, top, right, bottom] in pixels of
    /// the raw image, right and bottom not included: [[0, 0, 400, 752, 480]]; up to 8 a camera. Draw them 5 px larger than what
    /// is seen.
    masks: Vec<[u32; 5]> = Vec::new();
}

section! {
    /// The cameras of a live run, through V4L2.
    CameraConfig, "camera.";
    /// One name for each camera of the calibration, in its order, or one device that gives all images side by side:
    /// serial:NUMBER of the USB device, bus:INFO of `v4l2-ctl --list-devices`, or path:LINK of /dev/v4l/by-path. Numbers of
    /// /dev/video change from boot to boot. A live run needs it.
    devices: Vec<String> = Vec::new();
    /// Pixel format: grey, y10, y12, y16, y10p, y12p, nv12, yuyv, rggb, grbg, gbrg, bggr (a sensor's own pixels of 8 bits) or
    /// mjpeg; empty: the first of these that the camera has, with map.colour the first from nv12 on. Name a grey one where the
    /// camera has several and the map is grey: it costs least.
    format: String = String::new();
    /// Frames a second, the trigger's too. More than 30 costs CPU time and gains little.
    rate_hz: f64 = 20.0, Bound::Within(0.1, 1000.0);
    /// Exposure time; 0: as the camera has it, followed from frame to frame where its driver tells. Fix it: an automatic one is
    /// told a frame late, which moves stamps by half its change, and a long one blurs.
    exposure_us: u32 = 0, Bound::Within(0.0, 1_000_000.0);
    /// Time of one line, where the camera counts its exposure in lines (a line of a sensor takes 5 to 60 µs); 0: it counts in
    /// time.
    exposure_line_us: f64 = 0.0, Bound::Within(0.0, 1000.0);
    /// Any other control, by the names of `v4l2-ctl --list-ctrls`: gain = 16, black_level = 64, trigger_mode = 1.
    controls: BTreeMap<String, i64> = BTreeMap::new();
    /// What the driver stamps: driver (as its flags say), exposure-start, frame-start (CSI receivers, and uvcvideo although it
    /// says otherwise) or frame-end.
    stamp: StampPoint = StampPoint::Driver;
    /// Time from the end of the first row's exposure until the last row is received: by so much frame-end stamps are late.
    transfer_s: f64 = 0.0, Bound::Within(0.0, 0.5);
    /// Largest difference of one frame's images: live of the starts of their exposures or of the ends, in recordings of their
    /// stamps. Two milliseconds are for cameras of one trigger; two that run freely need up to half a period.
    pair_tolerance_s: f64 = 0.002, Bound::Within(0.0, 1.0);
}

section! {
    /// The inertial unit of a live run.
    ImuConfig, "imu.";
    /// bmi088, bmi270, icm-42688-p, icm-20948, lsm6dsox, mpu-9250 or mpu-6500, driven by its registers; iio, driven by the
    /// kernel. A live run needs it.
    chip: String = String::new();
    /// Where the unit is: its I2C adapter (a path, or the name of `i2cdetect -l`), its spidev node (/dev/spidev0.0), or with iio
    /// the name, label or place of the device. Of a unit with two dies, the gyro.
    device: String = String::new();
    /// The accelerometer's device, where that is another: the second spidev node of a BMI088, or a second IIO device.
    accel_device: String = String::new();
    /// I2C address, of the gyro.
    address: u16 = 0x68, Bound::Within(3.0, 119.0);
    /// I2C address of the accelerometer of a unit with two dies.
    accel_address: u16 = 0x18, Bound::Within(3.0, 119.0);
    /// SPI clock, Hz. MPUs take no more than 1 MHz; others 8 MHz and more.
    spi_hz: u32 = 1_000_000, Bound::Within(10_000.0, 24_000_000.0);
    /// IIO trigger of a device that has no interrupt of its own.
    trigger: String = String::new();
    /// Samples a second; the unit's nearest within 10 % is taken. 200 do for a drone; more follow vibration better.
    rate_hz: f64 = 200.0, Bound::Within(10.0, 4000.0);
    /// The smallest of the unit's ranges that holds this is taken; samples at its end weigh little.
    accel_range_g: f64 = 16.0, Bound::Within(1.0, 64.0);
    /// The same of the gyro.
    gyro_range_dps: f64 = 2000.0, Bound::Within(50.0, 8000.0);
    /// Whether the unit tests itself when it is opened, which takes up to two seconds at rest.
    self_test: bool = false;
    /// Path of the 8192 bytes that a BMI270 needs at each start: bmi270_config_file of Bosch's BMI270_SensorAPI.
    configuration: String = String::new();
}

section! {
    /// GPIO lines, as CHIP:LINE: label, name or path of the chip (`gpiodetect`; labels do not change), name or offset of the
    /// line (`gpioinfo`). A leading ! says that the line is active low, or falls.
    GpioConfig, "gpio.";
    /// Line on which the inertial unit says that a sample is ready; of a unit with two dies the gyro's. Without it samples are
    /// stamped by the times of reading, within 0.2 ms on a bus that is served in time.
    data_ready: String = String::new();
    /// Line that starts the cameras' exposures, at camera.rate_hz. Wire it where the cameras can be triggered.
    trigger: String = String::new();
    /// Length of a trigger pulse. The default is long enough for the opto-couplers of machine-vision cameras.
    trigger_pulse_us: u32 = 100, Bound::Within(1.0, 100_000.0);
    /// Line of a status LED: flashes at boot, is on while frames are tracked, blinks while they are not, flashes thrice a second
    /// on a fault.
    led: String = String::new();
}

section! {
    /// A barometer, if there is one. That of a recording is used, too, where this names a chip.
    BaroConfig, "baro.";
    /// bmp388, driven by its registers, or iio, driven by the kernel; empty: there is none. It holds the height of a climb.
    chip: String = String::new();
    /// Where it is: its I2C adapter (a path, or the name of `i2cdetect -l`), or with iio the name, label or place of the device.
    device: String = String::new();
    /// Its address on the I2C bus: 0x76 or 0x77.
    address: u16 = 0x76, Bound::Within(8.0, 119.0);
    /// Standard deviation of a reading. Raise it where rotors or wind press on the sensor.
    noise_m: f64 = 0.03, Bound::Within(0.001, 100.0);
    /// Standard deviation of its drift in ten minutes, the weather's included.
    drift_m: f64 = 1.0, Bound::Within(0.001, 1000.0);
    /// Temperature of the air at the start: ten degrees wrong make a climb 3.5 percent too long or too short.
    air_c: f64 = 15.0, Bound::Within(-60.0, 60.0);
}

section! {
    /// Recording beside a run.
    RecordConfig, "record.";
    /// Frames that wait for the disk; those beyond are dropped from the recording, and counted. SD cards stall for a second now
    /// and then: the default is 1.6 s at 20 Hz, 22 MiB of two 752x480 cameras.
    ring_frames: u32 = 32, Bound::Within(1.0, 4096.0);
}

section! {
    /// The log of a run.
    LogConfig, "log.";
    /// Rate at which the newest state, carried by the inertial samples to the newest of them, is logged on /predicted, between
    /// frames and while none comes: one a sample at most, of odometry in real time; 0: none. Each takes 500 bytes.
    predicted_hz: f64 = 0.0, Bound::Within(0.0, 1000.0);
}

impl RigConfig {
    /// Puts the masks into a calibration; an error where one is not within its camera's image.
    pub fn mask(&self, calibration: &mut Calibration) -> Result<(), Fault> {
        let count = calibration.cameras.len();
        for [camera, left, top, right, bottom] in &self.masks {
            let (camera, mask) = (*camera, Mask { left: *left, top: *top, right: *right, bottom: *bottom });
            let wrong = |what: String| {
                let what = format!("[{camera}, {left}, {top}, {right}, {bottom}] {what}");
                let fix = "write [camera, left, top, right, bottom] in pixels of that camera's raw image";
                Err(Fault::new(FaultKind::Config, "rig.masks", what, fix))
            };
            let Some(of) = calibration.cameras.get_mut(camera as usize) else {
                return wrong(format!(
                    "is of a camera that the rig has not: cameras are 0 to {}",
                    count.saturating_sub(1)
                ));
            };
            let (w, h) = (of.camera.width, of.camera.height);
            if left >= right || top >= bottom || *right as usize > w || *bottom as usize > h {
                return wrong(format!("is no rectangle within an image of {w}x{h} px"));
            }
            let Some(free) = of.masks.iter_mut().find(|m| **m == Mask::default()) else {
                return wrong(format!("is one too many: a camera has up to {MASKS_MAX}"));
            };
            *free = mask;
        }
        Ok(())
    }
}

/// A key and what is wrong with its value.
pub(super) type Wrong = (&'static str, String);

impl CameraConfig {
    /// The first key that is wrong, and why.
    pub(super) fn wrong(&self) -> Option<Wrong> {
        if let Some(why) = self.devices.iter().find_map(|d| Select::parse(d).err()) {
            return Some(("camera.devices", format!("camera.devices: {why}")));
        }
        if let Some(twice) = self.devices.iter().enumerate().find(|(i, d)| self.devices[..*i].contains(d)) {
            return Some(("camera.devices", format!("camera.devices names {} twice: name each camera once", twice.1)));
        }
        if let Err(why) = self.format() {
            return Some(("camera.format", format!("camera.format: {}", why.message())));
        }
        if self.devices.len() > 1 && self.pair_tolerance_s * self.rate_hz >= 0.5 {
            let why = "camera.pair_tolerance_s must be less than half a period of camera.rate_hz";
            return Some(("camera.pair_tolerance_s", format!("{why}: any two images would pair")));
        }
        None
    }

    fn format(&self) -> Result<Option<Format>, toml::de::Error> {
        let named = toml::Value::String(self.format.clone());
        if self.format.is_empty() {
            Ok(None)
        } else {
            Format::deserialize(named).map(Some)
        }
    }

    /// What the driver is asked for, with images of the calibration's size, the first `colours` cameras in colour; an error where
    /// the board names no camera.
    pub fn settings(&self, calibration: &Calibration, colours: usize) -> Result<Settings, Fault> {
        let fault = |what: String, fix: &str| Fault::new(FaultKind::Config, "camera.devices", what, fix);
        if self.devices.is_empty() {
            let fix = "write [camera] with devices = [\"serial:..\", ..] and rate_hz (`v4l2-ctl --list-devices`)";
            return Err(fault("the board file names no camera".to_string(), fix));
        }
        let devices = self.devices.iter().map(|d| Select::parse(d)).collect::<Result<_, _>>();
        let (width, height) = calibration.cameras.first().map_or((0, 0), |c| (c.camera.width, c.camera.height));
        Ok(Settings {
            devices: devices.map_err(|why| fault(why, ""))?,
            format: self.format().map_err(|why| fault(why.to_string(), ""))?,
            colours,
            width,
            height,
            rate_hz: self.rate_hz,
            exposure: Span(i64::from(self.exposure_us) * 1000),
            exposure_line: Span((self.exposure_line_us * 1e3).round() as i64),
            controls: self.controls.iter().map(|(name, value)| (name.clone(), *value)).collect(),
            stamp: self.stamp,
            transfer: Span::from_secs(self.transfer_s),
            pair_tolerance: Span::from_secs(self.pair_tolerance_s),
        })
    }
}

/// The barometer that is driven by its registers.
const BMP388: &str = "bmp388";
/// The chip's name that means the kernel's driver.
const IIO: &str = "iio";
/// How the paths of SPI devices begin; every other device is an I2C adapter.
const SPIDEV: &str = "/dev/spidev";

impl ImuConfig {
    /// Ends of the ranges of gyro and accelerometer, rad/s and m/s².
    pub fn range(&self) -> [f64; 2] {
        const G: f64 = 9.80665;
        [self.gyro_range_dps.to_radians(), self.accel_range_g * G]
    }

    /// The first key that is wrong, and why.
    pub(super) fn wrong(&self, gpio: &GpioConfig) -> Option<Wrong> {
        let somewhere = "must say where imu.chip is: I2C adapter, spidev node or IIO device";
        let named = (!self.device.is_empty(), "imu.device", somewhere);
        let rules: &[(bool, &'static str, &str)] = match self.chip.as_str() {
            "" => &[],
            IIO => &[
                named,
                (gpio.data_ready.is_empty(), "gpio.data_ready", "must be empty with imu.chip = \"iio\": the kernel's driver has the line"),
            ],
            name => match Chip::named(name) {
                Err(fault) => return Some(("imu.chip", format!("imu.chip = {}; {}", fault.what, fault.fix))),
                Ok(chip) => &[
                    named,
                    (
                        chip.dies.len() == 1 || !self.device.starts_with(SPIDEV) || !self.accel_device.is_empty(),
                        "imu.accel_device",
                        "must name the spidev node of the accelerometer, as imu.device that of the gyro",
                    ),
                    (
                        name != "bmi270" || !self.configuration.is_empty(),
                        "imu.configuration",
                        "must name a file of the 8192 bytes of bmi270_config_file, from Bosch's BMI270_SensorAPI, without \
                         which it measures nothing",
                    ),
                ],
            },
        };
        let broken = rules.iter().find(|(holds, _, _)| !holds);
        broken.map(|(_, key, rule)| (*key, format!("{key} {rule}")))
    }

    /// The unit to open; none where the board has none.
    pub fn options(&self) -> Option<ImuOptions> {
        match self.chip.as_str() {
            "" => None,
            IIO => Some(ImuOptions::Iio(IioOptions {
                device: self.device.clone(),
                accel_device: self.accel_device.clone(),
                trigger: self.trigger.clone(),
                rate_hz: self.rate_hz,
                frozen_samples: frozen_readings(self.rate_hz),
                sysfs: "/sys/bus/iio/devices".into(),
                dev: "/dev".into(),
            })),
            name => Some(ImuOptions::Register(RegisterOptions {
                chip: name.into(),
                wiring: self.wiring(),
                rate_hz: self.rate_hz,
                accel_range_g: self.accel_range_g,
                gyro_range_dps: self.gyro_range_dps,
                self_test: self.self_test,
                configuration: self.configuration.clone().into(),
                frozen_samples: frozen_readings(self.rate_hz),
            })),
        }
    }

    /// Where each die is, the gyro's first.
    fn wiring(&self) -> Vec<Wiring> {
        let dies = Chip::named(&self.chip).map_or(1, |chip| chip.dies.len());
        let accel = if self.accel_device.is_empty() { &self.device } else { &self.accel_device };
        let wired = |device: &String, address: u16| match device.starts_with(SPIDEV) {
            true => Wiring::Spi { path: device.clone(), hz: self.spi_hz },
            false => Wiring::I2c { adapter: device.clone(), address },
        };
        [wired(&self.device, self.address), wired(accel, self.accel_address)].into_iter().take(dies).collect()
    }
}

/// A line, and whether it is active low; none of an empty text.
fn line(text: &str) -> Result<Option<(LineName, bool)>, String> {
    if text.is_empty() {
        return Ok(None);
    }
    let (low, name) = text.strip_prefix('!').map_or((false, text), |name| (true, name));
    match name.rsplit_once(':').filter(|(chip, line)| !chip.is_empty() && !line.is_empty()) {
        Some((chip, line)) => Ok(Some((LineName { chip: chip.into(), line: line.into() }, low))),
        None => Err(format!("`{text}` is not CHIP:LINE, such as pinctrl-rp1:GPIO25")),
    }
}

impl BaroConfig {
    /// The first key that is wrong, and why.
    pub(super) fn wrong(&self) -> Option<Wrong> {
        let known = ["", BMP388, IIO].contains(&self.chip.as_str());
        (!known).then(|| ("baro.chip", format!("baro.chip = \"{}\" must be {BMP388} or {IIO}", self.chip)))
    }

    /// The barometer to open; none where the board has none.
    pub fn options(&self) -> Option<BaroOptions> {
        let device = || self.device.clone();
        match self.chip.as_str() {
            "" => None,
            IIO => Some(BaroOptions::Iio { device: device() }),
            _ => Some(BaroOptions::Bmp388 { adapter: device(), address: self.address }),
        }
    }

    /// Whether there is one.
    pub fn is_named(&self) -> bool {
        !self.chip.is_empty()
    }
}

impl GpioConfig {
    /// The first key that is wrong, and why.
    pub(super) fn wrong(&self) -> Option<Wrong> {
        let lines = [("gpio.data_ready", &self.data_ready), ("gpio.trigger", &self.trigger), ("gpio.led", &self.led)];
        lines.into_iter().find_map(|(key, text)| Some((key, format!("{key}: {}", line(text).err()?))))
    }

    pub fn data_ready(&self) -> Option<(LineName, Edge)> {
        let (name, low) = line(&self.data_ready).ok().flatten()?;
        Some((name, if low { Edge::Falling } else { Edge::Rising }))
    }

    /// Line, whether it is active low, and length of the pulse.
    pub fn trigger(&self) -> Option<(LineName, bool, Span)> {
        let (name, low) = line(&self.trigger).ok().flatten()?;
        Some((name, low, Span(i64::from(self.trigger_pulse_us) * 1000)))
    }

    /// Line, and whether it is active low.
    pub fn led(&self) -> Option<(LineName, bool)> {
        line(&self.led).ok().flatten()
    }
}
