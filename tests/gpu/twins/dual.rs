//! Forward-mode derivatives: a value and its partials by the 12 parameters of one Gaussian and the 6 of the pose.

use std::ops::{Add, Div, Mul, Neg, Sub};

pub const PARTIALS: usize = 18;

#[derive(Clone, Copy, Debug)]
pub struct Dual {
    pub v: f64,
    pub d: [f64; PARTIALS],
}

pub fn constant(v: f64) -> Dual {
    Dual { v, d: [0.0; PARTIALS] }
}

pub fn variable(v: f64, i: usize) -> Dual {
    let mut x = constant(v);
    x.d[i] = 1.0;
    x
}

impl Dual {
    /// f(x) with its derivative.
    fn map(self, v: f64, slope: f64) -> Dual {
        Dual { v, d: self.d.map(|d| d * slope) }
    }

    pub fn exp(self) -> Dual {
        self.map(self.v.exp(), self.v.exp())
    }

    pub fn sqrt(self) -> Dual {
        self.map(self.v.sqrt(), 0.5 / self.v.sqrt())
    }

    /// atan2(self, x) for self >= 0.
    pub fn atan2(self, x: Dual) -> Dual {
        let n = self.v * self.v + x.v * x.v;
        let v = self.v.atan2(x.v);
        Dual { v, d: std::array::from_fn(|i| (self.d[i] * x.v - x.d[i] * self.v) / n) }
    }

    pub fn sigmoid(self) -> Dual {
        let s = 1.0 / (1.0 + (-self.v).exp());
        self.map(s, s * (1.0 - s))
    }

    /// A constant past either bound.
    pub fn clamp(self, low: f64, high: f64) -> Dual {
        if self.v < low || self.v > high {
            constant(self.v.clamp(low, high))
        } else {
            self
        }
    }
}

impl Add for Dual {
    type Output = Dual;
    fn add(self, o: Dual) -> Dual {
        Dual { v: self.v + o.v, d: std::array::from_fn(|i| self.d[i] + o.d[i]) }
    }
}

impl Sub for Dual {
    type Output = Dual;
    fn sub(self, o: Dual) -> Dual {
        self + -o
    }
}

impl Neg for Dual {
    type Output = Dual;
    fn neg(self) -> Dual {
        self.map(-self.v, -1.0)
    }
}

#[allow(clippy::suspicious_arithmetic_impl)] // the product rule
impl Mul for Dual {
    type Output = Dual;
    fn mul(self, o: Dual) -> Dual {
        Dual { v: self.v * o.v, d: std::array::from_fn(|i| self.d[i] * o.v + self.v * o.d[i]) }
    }
}

#[allow(clippy::suspicious_arithmetic_impl)]
impl Div for Dual {
    type Output = Dual;
    fn div(self, o: Dual) -> Dual {
        self * o.map(1.0 / o.v, -1.0 / (o.v * o.v))
    }
}

pub fn dot(a: [Dual; 3], b: [Dual; 3]) -> Dual {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn cross(a: [Dual; 3], b: [Dual; 3]) -> [Dual; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
