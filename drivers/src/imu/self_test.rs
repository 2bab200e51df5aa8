//! The self-test of a die: its proof masses are deflected by a known force, and their answer is compared with what the data
//! sheet, or the factory's measurement of this very die, demands. The board must stand still meanwhile.

use super::chips::{BuiltInTest, DieSpec, ExcitationTest, FactoryTest, SelfTest, Sensor, SensorSpec, Step};
use super::die::Die;
use super::error::ImuError;
use crate::types::Span;

/// Samples whose mean is taken, 1 ms apart, as in InvenSense's procedure.
const SAMPLES: usize = 200;
/// How long a die that tests itself may take: Bosch's own driver gives it half a second.
const BUILT_IN_MS: u32 = 500;
/// Answer at the factory, steps, of a die with code 1 (AN-MPU-9250A-03).
const FACTORY_BASE: f64 = 2620.0;

/// Runs the tests of a die; the die must be started after them.
pub fn self_test(die: &mut Die) -> Result<(), ImuError> {
    die.wake()?;
    die.spec.self_tests.iter().try_for_each(|test| match test {
        SelfTest::Excitation(test) => excitation(die, test),
        SelfTest::Factory(test) => factory(die, test),
        SelfTest::BuiltIn(test) => built_in(die, test),
    })
}

fn built_in(die: &mut Die, test: &BuiltInTest) -> Result<(), ImuError> {
    die.run(test.prepare)?;
    die.write(test.trigger.0, test.trigger.1)?;
    die.expect(test.answer, test.done, test.done, BUILT_IN_MS)?;
    let answer = die.read_byte(test.answer)?;
    if answer & test.verdict == test.good {
        Ok(())
    } else {
        let sensor = if test.sensor == Sensor::Accel { "accelerometer" } else { "gyro" };
        Err(ImuError::SelfTest(sensor, f64::from(answer)))
    }
}

fn excitation(die: &mut Die, test: &ExcitationTest) -> Result<(), ImuError> {
    die.run(test.prepare)?;
    die.run(test.on)?;
    let on = mean(die, test.sensor)?;
    die.run(test.off)?;
    let off = mean(die, test.sensor)?;
    (0..3).try_for_each(|i| {
        // Data sheets give the size; the sign depends on how the masses lie.
        check(test.sensor, i, (on[i] - off[i]).abs() * test.per_lsb, test.within[i])
    })
}

fn factory(die: &mut Die, test: &FactoryTest) -> Result<(), ImuError> {
    let ((switch, force), settle) = (test.switch, Step::WaitUs(test.settle_us));
    die.run(test.prepare)?;
    die.run(&[settle])?;
    let off = mean(die, test.sensor)?;
    die.run(&[Step::Write(switch, force), settle])?;
    let on = mean(die, test.sensor)?;
    die.run(&[Step::Write(switch, 0), settle])?;
    let mut codes = [0; 3];
    for (code, register) in codes.iter_mut().zip(test.codes..) {
        *code = die.read_byte(register)?;
    }
    // Code 0: the factory left no measurement, and the answer itself must do.
    let coded = codes.iter().all(|code| *code != 0);
    (0..3).try_for_each(|i| {
        let answer = (on[i] - off[i]).abs();
        let expected = FACTORY_BASE * 1.01f64.powi(i32::from(codes[i]) - 1);
        let (answer, within) = if coded { (answer / expected, test.ratio) } else { (answer, test.uncoded) };
        check(test.sensor, i, answer, within)
    })
}

fn check(sensor: Sensor, axis: usize, answer: f64, (least, most): (f64, f64)) -> Result<(), ImuError> {
    const AXES: [[&str; 3]; 2] =
        [["accelerometer x", "accelerometer y", "accelerometer z"], ["gyro x", "gyro y", "gyro z"]];
    if (least..=most).contains(&answer) {
        Ok(())
    } else {
        Err(ImuError::SelfTest(AXES[usize::from(sensor == Sensor::Gyro)][axis], answer))
    }
}

/// Mean of a sensor's samples, counts.
fn mean(die: &mut Die, sensor: Sensor) -> Result<[f64; 3], ImuError> {
    let mut sum = [0.0; 3];
    for _ in 0..SAMPLES {
        let raw = die.newest(spec(die.spec, sensor))?;
        (0..3).for_each(|i| sum[i] += f64::from(raw[i]));
        die.bus.sleep(Span(1_000_000));
    }
    Ok(sum.map(|s| s / SAMPLES as f64))
}

fn spec(die: &'static DieSpec, sensor: Sensor) -> &'static SensorSpec {
    let spec = if sensor == Sensor::Accel { die.accel.as_ref() } else { die.gyro.as_ref() };
    spec.expect("a die's tests are of sensors it has")
}
