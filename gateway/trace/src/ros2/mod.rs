//! Messages as ROS 2 writes them: the encoding (CDR) and the types that recordings carry, with their definitions.
//!
//! Viewers and bag tools interpret these bytes by the definition that stands in the file beside them; neither ROS
//! nor a generated type is needed on either side.

pub mod cdr;
pub mod messages;
pub mod read;
pub mod skin;
pub mod standard;

/// A type of message: what a recording says of it, and how its bytes come about.
pub trait Message {
    /// Its full name, `package/msg/Type`.
    const TYPE: &'static str;
    /// Its fields and those of every type in it (encoding `ros2msg`).
    const DEFINITION: &'static str;

    /// Writes it, without the encoding's head.
    fn write(&self, out: &mut cdr::Writer<'_>);

    /// Writes it into a buffer, in the place of what is there; allocates only while the buffer grows.
    fn encode_into(&self, buffer: &mut Vec<u8>) {
        self.write(&mut cdr::Writer::new(buffer));
    }
}
