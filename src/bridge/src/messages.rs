//! Messages of ROS 2 as CDR lays them out: fields in the order of their .msg files. A vector is `[x, y, z]`, a quaternion
//! `[x, y, z, w]`, a 6x6 matrix row by row; CDR writes an array without its length, so these are what ROS has.

use serde::Serialize;

/// Levels of DiagnosticStatus.
pub const OK: u8 = 0;
pub const WARN: u8 = 1;
pub const ERROR: u8 = 2;

/// PointField's code of a 32-bit float.
pub const FLOAT32: u8 = 7;

/// 6x6 covariance: three numbers of translation, three of rotation.
pub type Covariance = [[f64; 6]; 6];

/// The name that DDS has for a type of ROS.
pub trait Message: Serialize {
    const TYPE: &'static str;
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Time {
    pub sec: i32,
    pub nanosec: u32,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Header {
    pub stamp: Time,
    pub frame_id: String,
}

/// nav_msgs/Odometry, its nested messages unfolded.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Odometry {
    pub header: Header,
    pub child_frame_id: String,
    /// m, in the frame of the header.
    pub position: [f64; 3],
    pub orientation: [f64; 4],
    /// m² and rad², about the axes of the header's frame.
    pub pose_covariance: Covariance,
    /// m/s, in the child frame.
    pub linear: [f64; 3],
    /// rad/s, in the child frame.
    pub angular: [f64; 3],
    /// m²/s² and rad²/s², in the child frame.
    pub twist_covariance: Covariance,
}

impl Message for Odometry {
    const TYPE: &'static str = "nav_msgs::msg::dds_::Odometry_";
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TransformStamped {
    pub header: Header,
    pub child_frame_id: String,
    /// m.
    pub translation: [f64; 3],
    pub rotation: [f64; 4],
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TfMessage {
    pub transforms: Vec<TransformStamped>,
}

impl Message for TfMessage {
    const TYPE: &'static str = "tf2_msgs::msg::dds_::TFMessage_";
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointField {
    pub name: &'static str,
    pub offset: u32,
    pub datatype: u8,
    pub count: u32,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointCloud2 {
    pub header: Header,
    pub height: u32,
    pub width: u32,
    pub fields: Vec<PointField>,
    pub is_bigendian: bool,
    pub point_step: u32,
    pub row_step: u32,
    pub data: Vec<u8>,
    pub is_dense: bool,
}

impl Message for PointCloud2 {
    const TYPE: &'static str = "sensor_msgs::msg::dds_::PointCloud2_";
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KeyValue {
    pub key: String,
    pub value: String,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DiagnosticStatus {
    pub level: u8,
    pub name: String,
    pub message: String,
    pub hardware_id: String,
    pub values: Vec<KeyValue>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DiagnosticArray {
    pub header: Header,
    pub status: Vec<DiagnosticStatus>,
}

impl Message for DiagnosticArray {
    const TYPE: &'static str = "diagnostic_msgs::msg::dds_::DiagnosticArray_";
}
