//! The messages of Foxglove's WebSocket protocol, as far as a server needs them that only sends.
//!
//! The protocol is that of `docs/spec.md` in the repository `foxglove/ws-protocol`, subprotocol `foxglove.websocket.v1`.
//! Newer viewers name it `foxglove.sdk.v1`; the messages used here are the same.

use serde::{Deserialize, Serialize};

/// The names of the subprotocol, the preferred one first.
pub(super) const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// The capability to tell viewers the time of a recording that is played.
const TIME_CAPABILITY: &str = "time";

/// Operation codes of binary messages from the server.
mod opcode {
    pub(super) const MESSAGE_DATA: u8 = 1;
    pub(super) const TIME: u8 = 2;
}

/// A channel as viewers see it.
#[derive(Clone, Debug, Eq, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct AdvertisedChannel {
    pub(super) id: u32,
    pub(super) topic: String,
    pub(super) encoding: String,
    pub(super) schema_name: String,
    pub(super) schema: String,
    pub(super) schema_encoding: String,
}

/// The importance of a status message.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
#[repr(u8)]
pub(super) enum StatusLevel {
    Warning = 1,
    Error = 2,
}

/// A text message to a viewer.
#[derive(Debug, Serialize)]
#[serde(tag = "op", rename_all = "camelCase")]
enum ServerMessage<'a> {
    #[serde(rename_all = "camelCase")]
    ServerInfo {
        name: &'a str,
        capabilities: &'a [&'a str],
        session_id: &'a str,
    },
    Advertise {
        channels: &'a [AdvertisedChannel],
    },
    Status {
        level: u8,
        message: &'a str,
    },
}

/// A message from a viewer.
#[derive(Clone, Debug, Eq, PartialEq)]
pub(super) enum ClientMessage {
    /// The pairs of subscription and channel that the viewer begins.
    Subscribe(Vec<Subscription>),
    /// The subscriptions that the viewer ends.
    Unsubscribe(Vec<u32>),
}

/// A subscription of a viewer: its own number, and the channel.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq)]
#[serde(rename_all = "camelCase")]
pub(super) struct Subscription {
    pub(super) id: u32,
    pub(super) channel_id: u32,
}

/// The fields of a message from a viewer.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct ClientFields {
    op: String,
    #[serde(default)]
    subscriptions: Vec<Subscription>,
    #[serde(default)]
    subscription_ids: Vec<u32>,
}

impl ClientMessage {
    /// Parses a text message.
    ///
    /// # Errors
    /// Returns the text of a status message if the message is invalid or not supported.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let fields: ClientFields = serde_json::from_str(text).map_err(|error| {
            format!(
                "this message is not understood: {error}; send subscribe or unsubscribe of {}",
                SUBPROTOCOLS[1]
            )
        })?;
        match fields.op.as_str() {
            "subscribe" => Ok(Self::Subscribe(fields.subscriptions)),
            "unsubscribe" => Ok(Self::Unsubscribe(fields.subscription_ids)),
            other => {
                let other: String = other.chars().take(40).collect();
                Err(format!(
                    "{other} is not supported: this server only sends; subscribe and unsubscribe are supported"
                ))
            }
        }
    }
}

/// Encodes the first message to a viewer. `session` changes with each start of the server.
pub(super) fn server_info(name: &str, has_time: bool, session: &str) -> String {
    let capabilities = if has_time { &[TIME_CAPABILITY][..] } else { &[] };
    to_json(&ServerMessage::ServerInfo { name, capabilities, session_id: session })
}

/// Encodes the announcement of channels.
pub(super) fn advertise(channels: &[AdvertisedChannel]) -> String {
    to_json(&ServerMessage::Advertise { channels })
}

/// Encodes a text for the user of the viewer.
pub(super) fn status(level: StatusLevel, message: &str) -> String {
    to_json(&ServerMessage::Status { level: level as u8, message })
}

/// Encodes a message of a channel, with its time in ns since 1970.
pub(super) fn message_data(subscription: u32, nanos: u64, message: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(13 + message.len());
    bytes.push(opcode::MESSAGE_DATA);
    bytes.extend(subscription.to_le_bytes());
    bytes.extend(nanos.to_le_bytes());
    bytes.extend(message);
    bytes
}

/// Encodes the time of a recording that is played, in ns since 1970.
pub(super) fn time(nanos: u64) -> Vec<u8> {
    [&[opcode::TIME][..], &nanos.to_le_bytes()].concat()
}

fn to_json(message: &ServerMessage<'_>) -> String {
    serde_json::to_string(message).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn messages_to_viewers_are_those_of_the_specification() {
        assert_eq!(
            server_info("skinbus", false, "17"),
            r#"{"op":"serverInfo","name":"skinbus","capabilities":[],"sessionId":"17"}"#
        );
        assert_eq!(
            server_info("a \"skin\"", true, "17"),
            r#"{"op":"serverInfo","name":"a \"skin\"","capabilities":["time"],"sessionId":"17"}"#
        );
        let channel = AdvertisedChannel {
            id: 3,
            topic: "/can/vcan0".to_owned(),
            encoding: "cdr".to_owned(),
            schema_name: "skinbus_msgs/msg/CanFrame".to_owned(),
            schema: "uint32 id\n".to_owned(),
            schema_encoding: "ros2msg".to_owned(),
        };
        let expected = r#"{"op":"advertise","channels":[{"id":3,"topic":"/can/vcan0","encoding":"cdr","schemaName":"skinbus_msgs/msg/CanFrame","schema":"uint32 id\n","schemaEncoding":"ros2msg"}]}"#;
        assert_eq!(advertise(&[channel]), expected);
        let expected = r#"{"op":"status","level":1,"message":"slow"}"#;
        assert_eq!(status(StatusLevel::Warning, "slow"), expected);
        assert!(status(StatusLevel::Error, "").contains("\"level\":2"));
    }

    #[test]
    fn binary_messages_stand_byte_for_byte_where_the_specification_says() {
        let expected = [1, 4, 3, 2, 1, 8, 7, 6, 5, 4, 3, 2, 1, 0xAA, 0xBB];
        assert_eq!(message_data(0x0102_0304, 0x0102_0304_0506_0708, &[0xAA, 0xBB]), expected);
        assert_eq!(message_data(0, 0, &[]), [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(time(0x0102_0304_0506_0708), [2, 8, 7, 6, 5, 4, 3, 2, 1]);
    }

    #[test]
    fn subscriptions_are_read_and_all_else_is_answered() {
        let text = r#"{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":1,"channelId":5}]}"#;
        let both = [(0, 3), (1, 5)].map(|(id, channel_id)| Subscription { id, channel_id });
        assert_eq!(ClientMessage::parse(text), Ok(ClientMessage::Subscribe(both.to_vec())));
        let text = r#"{"op":"unsubscribe","subscriptionIds":[0,1]}"#;
        assert_eq!(ClientMessage::parse(text), Ok(ClientMessage::Unsubscribe(vec![0, 1])));
        for op in ["advertise", "unadvertise", "getParameters", "setParameters", "fetchAsset", "callService"]
        {
            let text = format!(r#"{{"op":"{op}","channels":[]}}"#);
            let error = ClientMessage::parse(&text).unwrap_err();
            assert!(error.starts_with(&format!("{op} is not supported: this server only sends")), "{error}");
        }
        for text in
            ["", "{}", "[1]", "null", r#"{"op":3}"#, r#"{"op":"subscribe","subscriptions":[{"id":-1}]}"#]
        {
            let error = ClientMessage::parse(text).unwrap_err();
            assert!(
                error.starts_with("this message is not understood: ") && !error.contains('\n'),
                "{error}"
            );
        }
    }

    proptest! {
        #[test]
        fn no_text_panics(text: String) {
            let _ = ClientMessage::parse(&text);
        }
    }
}
