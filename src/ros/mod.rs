//! ROS 2's messages without ROS: definitions (`ros2msg`) and bytes (CDR), for recordings. Knows nothing of ours.

pub mod cdr;
mod schema;
pub mod standard;

pub use cdr::{CdrError, Reader, Writer};
pub use schema::{Byte, Bytes, Field, Message};

#[cfg(test)]
mod tests {
    use super::standard::{DiagnosticArray, Header, Time};
    use super::*;

    #[test]
    fn a_definition_holds_every_message_in_it_once() {
        let schema = DiagnosticArray::schema();
        let separator = "=".repeat(80);
        let parts: Vec<&str> = schema.split(&format!("{separator}\n")).collect();
        assert_eq!(parts[0], "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n");
        let names: Vec<&str> = parts[1..].iter().filter_map(|part| part.lines().next()).collect();
        let want = ["std_msgs/Header", "builtin_interfaces/Time", "diagnostic_msgs/DiagnosticStatus"];
        assert_eq!(names[..3], want.map(|name| format!("MSG: {name}")));
        assert_eq!(parts[2], "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n");
    }

    #[test]
    fn a_header_is_written_as_ros_writes_it() {
        let header = Header { stamp: Time::from_ns(1_500_000_000_000_000_007), frame_id: "map" };
        let bytes = header.to_cdr();
        let want = [
            [0, 1, 0, 0].as_slice(),
            &1_500_000_000_i32.to_le_bytes(),
            &7_u32.to_le_bytes(),
            &4_u32.to_le_bytes(),
            b"map\0",
        ];
        assert_eq!(bytes, want.concat());
        assert_eq!(Time::from_ns(-1), Time { sec: -1, nanosec: 999_999_999 });
    }
}
