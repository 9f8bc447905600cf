//! A message's type as Rust knows it, its definition as ROS 2 writes it, and its bytes, from one list of fields, so that they cannot differ.

use super::cdr::Writer;

/// Whatever may stand in a message.
pub trait Field {
    /// As it stands in a definition: `uint8`, `float64[9]`, `std_msgs/Header`.
    fn type_name() -> String;
    /// An array of so many. ROS 2 has no arrays of arrays: theirs are as long as all of them.
    fn array_name(length: usize) -> String {
        format!("{}[{length}]", Self::type_name())
    }
    /// Adds the definitions of the messages that this type is made of, itself first, each once.
    fn definitions(_found: &mut Vec<(String, String)>) {}
    /// Appends the value.
    fn write(&self, out: &mut Writer);
}

/// What may stand in a recording by itself.
pub trait Message: Field {
    /// `std_msgs/msg/Header`.
    const NAME: &'static str;

    /// The definition with those of all messages in it, as bags hold it (encoding `ros2msg`).
    fn schema() -> String {
        let mut found = Vec::new();
        Self::definitions(&mut found);
        let mut texts = found.into_iter();
        let mut schema = texts.next().map(|(_, text)| text).unwrap_or_default();
        for (name, text) in texts {
            schema += &format!("{}\nMSG: {name}\n{text}", "=".repeat(80));
        }
        schema
    }

    /// The message as CDR.
    fn to_cdr(&self) -> Vec<u8> {
        let mut out = Writer::default();
        self.write(&mut out);
        out.into_bytes()
    }
}

macro_rules! numbers {
    ($($type:ty = $name:literal),+) => {$(
        impl Field for $type {
            fn type_name() -> String {
                $name.into()
            }
            fn write(&self, out: &mut Writer) {
                out.number(self.to_le_bytes());
            }
        }
    )+};
}
numbers!(u8 = "uint8", i32 = "int32", u32 = "uint32", i64 = "int64", u64 = "uint64", f32 = "float32", f64 = "float64");

impl Field for bool {
    fn type_name() -> String {
        "bool".into()
    }
    fn write(&self, out: &mut Writer) {
        out.number([u8::from(*self)]);
    }
}

/// ROS 2's `byte`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Byte(pub u8);

impl Field for Byte {
    fn type_name() -> String {
        "byte".into()
    }
    fn write(&self, out: &mut Writer) {
        out.number([self.0]);
    }
}

impl Field for &str {
    fn type_name() -> String {
        "string".into()
    }
    fn write(&self, out: &mut Writer) {
        out.length(self.len() + 1);
        out.raw(self.as_bytes());
        out.raw(&[0]);
    }
}

impl Field for String {
    fn type_name() -> String {
        "string".into()
    }
    fn write(&self, out: &mut Writer) {
        self.as_str().write(out);
    }
}

/// `uint8[]`, copied at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bytes<'a>(pub &'a [u8]);

impl Field for Bytes<'_> {
    fn type_name() -> String {
        "uint8[]".into()
    }
    fn write(&self, out: &mut Writer) {
        out.length(self.0.len());
        out.raw(self.0);
    }
}

impl<T: Field, const N: usize> Field for [T; N] {
    fn type_name() -> String {
        T::array_name(N)
    }
    fn array_name(length: usize) -> String {
        T::array_name(N * length)
    }
    fn definitions(found: &mut Vec<(String, String)>) {
        T::definitions(found);
    }
    fn write(&self, out: &mut Writer) {
        self.iter().for_each(|element| element.write(out));
    }
}

impl<T: Field> Field for &[T] {
    fn type_name() -> String {
        format!("{}[]", T::type_name())
    }
    fn definitions(found: &mut Vec<(String, String)>) {
        T::definitions(found);
    }
    fn write(&self, out: &mut Writer) {
        out.length(self.len());
        self.iter().for_each(|element| element.write(out));
    }
}

impl<T: Field> Field for Vec<T> {
    fn type_name() -> String {
        <&[T]>::type_name()
    }
    fn definitions(found: &mut Vec<(String, String)>) {
        T::definitions(found);
    }
    fn write(&self, out: &mut Writer) {
        self.as_slice().write(out);
    }
}

/// Makes an existing type a message: its name and its fields with their types, in order.
#[macro_export]
#[doc(hidden)]
macro_rules! ros_fields {
    ([$($life:lifetime)?] $type:ty, $name:literal, { $($field:ident: $kind:ty),+ $(,)? }) => {
        impl$(<$life>)? $crate::ros::Field for $type {
            fn type_name() -> String {
                $name.replacen("/msg/", "/", 1)
            }
            fn definitions(found: &mut Vec<(String, String)>) {
                let name = <Self as $crate::ros::Field>::type_name();
                if found.iter().any(|(known, _)| *known == name) {
                    return;
                }
                let mut text = String::new();
                $(text += &format!("{} {}\n", <$kind as $crate::ros::Field>::type_name(), stringify!($field));)+
                found.push((name, text));
                $(<$kind as $crate::ros::Field>::definitions(found);)+
            }
            fn write(&self, out: &mut $crate::ros::Writer) {
                $(<$kind as $crate::ros::Field>::write(&self.$field, out);)+
            }
        }
        impl$(<$life>)? $crate::ros::Message for $type {
            const NAME: &'static str = $name;
        }
    };
}

/// Makes a type that is a message.
macro_rules! message {
    ($(#[$doc:meta])* $type:ident$(<$life:lifetime>)?, $name:literal, { $($field:ident: $kind:ty),+ $(,)? }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq)]
        pub struct $type$(<$life>)? {
            $(pub $field: $kind,)+
        }
        $crate::ros_fields!([$($life)?] $type$(<$life>)?, $name, { $($field: $kind),+ });
    };
}
pub(super) use message;
