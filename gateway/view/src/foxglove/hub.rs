//! The channels that viewers can subscribe to, and the distribution of their messages to all viewers.

use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex};

use trace::capture::ChannelDescription;
use trace::recording::file::Channel;
use trace::recording::message_sink::{ChannelSink, MessageSink};
use trace::ros2::Message;
use trace::ros2::topic::{MESSAGE_ENCODING, QOS_KEY, SCHEMA_ENCODING, is_latched};

use super::protocol::{AdvertisedChannel, ClientMessage, StatusLevel, advertise, server_info, status, time};
use super::queue::{QueuedMessage, ViewerQueue};
use crate::lock_ignoring_poison;

/// A channel with its last message, if viewers that subscribe later need it.
#[derive(Debug)]
struct HubChannel {
    advertised: AdvertisedChannel,
    /// True if the last message holds until the next one, as a robot's description does.
    is_latched: bool,
    /// True if the last message is kept for viewers that subscribe later.
    keeps_last: bool,
    last: Option<(u64, Vec<u8>)>,
}

#[derive(Debug, Default)]
struct HubState {
    channels: Vec<HubChannel>,
    viewers: BTreeMap<u64, ViewerQueue>,
    time: Option<u64>,
}

/// Distributes messages to viewers. A message is encoded only if a viewer needs it.
#[derive(Debug)]
pub(super) struct MessageHub {
    name: String,
    session: String,
    /// True if messages come from a recording, whose time viewers are told.
    is_played: bool,
    state: Mutex<HubState>,
}

impl MessageHub {
    /// Creates a hub without channels. `session` changes with each start of the server.
    pub(super) fn new(name: String, session: String, is_played: bool) -> Self {
        Self { name, session, is_played, state: Mutex::default() }
    }

    /// Adds a channel and announces it to all viewers. Returns its number.
    pub(super) fn add_channel(&self, described: ChannelDescription) -> u32 {
        let mut state = lock_ignoring_poison(&self.state);
        let id = u32::try_from(state.channels.len()).unwrap_or(u32::MAX);
        let ChannelDescription { topic, encoding, schema_name, schema_encoding, schema, is_latched } =
            described;
        let schema = String::from_utf8_lossy(&schema).into_owned();
        let advertised = AdvertisedChannel { id, topic, encoding, schema_name, schema, schema_encoding };
        let text = advertise(std::slice::from_ref(&advertised));
        state.viewers.values_mut().for_each(|viewer| viewer.push_text(text.clone()));
        // A recording stands still while it is paused, so that viewers need the last message of each topic.
        let keeps_last = is_latched || self.is_played;
        state.channels.push(HubChannel { advertised, is_latched, keeps_last, last: None });
        id
    }

    /// Returns true if a message of a channel is needed: a viewer has subscribed, or may subscribe later.
    pub(super) fn needs(&self, channel: u32) -> bool {
        let state = lock_ignoring_poison(&self.state);
        state.channel(channel).is_some_and(|known| known.keeps_last)
            || state.viewers.values().any(|viewer| viewer.is_subscribed(channel))
    }

    /// Returns true if any viewer has subscribed to any channel.
    pub(super) fn has_subscribers(&self) -> bool {
        lock_ignoring_poison(&self.state).viewers.values().any(ViewerQueue::has_subscriptions)
    }

    /// Sends a message to all viewers that have subscribed to its channel.
    pub(super) fn publish(&self, channel: u32, nanos: u64, message: &[u8]) {
        let mut state = lock_ignoring_poison(&self.state);
        state.viewers.values_mut().for_each(|viewer| viewer.push(channel, nanos, message));
        if let Some(known) = state.channel_mut(channel).filter(|known| known.keeps_last) {
            known.last = Some((nanos, message.to_vec()));
        }
    }

    /// Tells all viewers the time of the recording, in ns since 1970.
    pub(super) fn publish_time(&self, nanos: u64) {
        let mut state = lock_ignoring_poison(&self.state);
        if state.time.replace(nanos) != Some(nanos) {
            state.viewers.values_mut().for_each(|viewer| viewer.set_time(time(nanos)));
        }
    }

    /// Removes all messages that wait for viewers, because the recording is played from another position. Viewers get
    /// the latched ones again, because they forget everything when time goes back.
    pub(super) fn clear_messages(&self) {
        let mut state = lock_ignoring_poison(&self.state);
        let HubState { channels, viewers, .. } = &mut *state;
        let latched = channels.iter().filter(|known| known.is_latched);
        let latched = latched.filter_map(|known| Some((known.advertised.id, known.last.as_ref()?)));
        viewers.values_mut().for_each(ViewerQueue::clear_messages);
        for (id, (nanos, message)) in latched {
            viewers.values_mut().for_each(|viewer| viewer.push(id, *nanos, message));
        }
    }

    /// Sends a text to the users of all viewers.
    pub(super) fn warn(&self, message: &str) {
        let text = status(StatusLevel::Error, message);
        let mut state = lock_ignoring_poison(&self.state);
        state.viewers.values_mut().for_each(|viewer| viewer.push_text(text.clone()));
    }

    /// Adds a viewer, and sends it the first messages.
    pub(super) fn add_viewer(&self, viewer: u64) {
        let mut state = lock_ignoring_poison(&self.state);
        let mut queue = ViewerQueue::default();
        queue.push_text(server_info(&self.name, self.is_played, &self.session));
        let channels: Vec<_> = state.channels.iter().map(|known| known.advertised.clone()).collect();
        queue.push_text(advertise(&channels));
        if let Some(nanos) = state.time {
            queue.set_time(time(nanos));
        }
        state.viewers.insert(viewer, queue);
    }

    /// Removes a viewer.
    pub(super) fn remove_viewer(&self, viewer: u64) {
        lock_ignoring_poison(&self.state).viewers.remove(&viewer);
    }

    /// Returns the next message for a viewer.
    pub(super) fn next_message(&self, viewer: u64) -> Option<QueuedMessage> {
        lock_ignoring_poison(&self.state).viewers.get_mut(&viewer)?.pop()
    }

    /// Tells a viewer how many messages were dropped, if that has changed.
    pub(super) fn report_dropped(&self, viewer: u64) {
        if let Some(viewer) = lock_ignoring_poison(&self.state).viewers.get_mut(&viewer) {
            viewer.report_dropped();
        }
    }

    /// Handles a message from a viewer. Wrong ones are answered with a status message.
    pub(super) fn handle_message(&self, viewer: u64, message: Result<ClientMessage, String>) {
        let mut state = lock_ignoring_poison(&self.state);
        let HubState { channels, viewers, .. } = &mut *state;
        let Some(queue) = viewers.get_mut(&viewer) else { return };
        match message {
            Err(why) => queue.push_text(status(StatusLevel::Error, &why)),
            Ok(ClientMessage::Unsubscribe(ids)) => ids.into_iter().for_each(|id| queue.unsubscribe(id)),
            Ok(ClientMessage::Subscribe(begun)) => {
                for subscription in begun {
                    let known = usize::try_from(subscription.channel_id).ok().and_then(|at| channels.get(at));
                    let last = known.and_then(|known| known.last.as_ref());
                    if queue.subscribe(subscription, known.is_some())
                        && let Some((nanos, message)) = last
                    {
                        queue.push(subscription.channel_id, *nanos, message);
                    }
                }
            }
        }
    }
}

impl HubState {
    fn channel(&self, channel: u32) -> Option<&HubChannel> {
        self.channels.get(usize::try_from(channel).ok()?)
    }

    fn channel_mut(&mut self, channel: u32) -> Option<&mut HubChannel> {
        self.channels.get_mut(usize::try_from(channel).ok()?)
    }
}

/// The hub as the destination of a recording's topics.
#[derive(Debug)]
pub(super) struct HubSink {
    hub: Arc<MessageHub>,
    buffer: Vec<u8>,
}

impl HubSink {
    pub(super) const fn new(hub: Arc<MessageHub>) -> Self {
        Self { hub, buffer: Vec::new() }
    }
}

impl ChannelSink for HubSink {
    fn add_channel<M: Message>(&mut self, topic: &str, facts: &[(&str, &str)]) -> io::Result<Channel> {
        let id = self.hub.add_channel(ChannelDescription {
            topic: topic.to_owned(),
            encoding: MESSAGE_ENCODING.to_owned(),
            schema_name: M::TYPE.to_owned(),
            schema_encoding: SCHEMA_ENCODING.to_owned(),
            schema: M::DEFINITION.as_bytes().to_vec(),
            is_latched: facts.iter().any(|(key, value)| *key == QOS_KEY && is_latched(value)),
        });
        let id = u16::try_from(id).map_err(|_| io::Error::other("there are more than 65536 topics"))?;
        Ok(Channel::with_id(id))
    }
}

impl MessageSink for HubSink {
    fn write_sorted_at<M: Message>(&mut self, channel: &mut Channel, _: u64, nanos: u64, message: &M) {
        let id = channel.id().into();
        if self.hub.needs(id) {
            message.encode_into(&mut self.buffer);
            self.hub.publish(id, nanos, &self.buffer);
        }
    }

    fn latest_ns(&self, _: &Channel) -> u64 {
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::foxglove::protocol::{Subscription, message_data};
    use trace::ros2::robot::StringMessage;

    fn described(topic: &str, is_latched: bool) -> ChannelDescription {
        ChannelDescription {
            topic: topic.to_owned(),
            encoding: "cdr".to_owned(),
            schema_name: "std_msgs/msg/String".to_owned(),
            schema_encoding: "ros2msg".to_owned(),
            schema: b"string data".to_vec(),
            is_latched,
        }
    }

    fn messages(hub: &MessageHub, viewer: u64) -> Vec<QueuedMessage> {
        std::iter::from_fn(|| hub.next_message(viewer)).collect()
    }

    fn subscribe(hub: &MessageHub, viewer: u64, id: u32, channel_id: u32) {
        hub.handle_message(viewer, Ok(ClientMessage::Subscribe(vec![Subscription { id, channel_id }])));
    }

    #[test]
    fn each_viewer_gets_what_it_subscribed_to_and_latched_messages_at_once() {
        let hub = MessageHub::new("skinbus".to_owned(), "1".to_owned(), false);
        let [plain, latched] =
            [("/plain", false), ("/latched", true)].map(|(topic, is)| hub.add_channel(described(topic, is)));
        assert!(!hub.needs(plain) && hub.needs(latched) && !hub.needs(9));
        hub.publish(plain, 1, b"lost");
        hub.publish(latched, 2, b"kept");
        hub.add_viewer(1);
        hub.add_viewer(2);
        let first = messages(&hub, 1);
        assert!(
            matches!(&first[..], [QueuedMessage::Text(info), QueuedMessage::Text(advertised)]
                if info.contains("serverInfo") && advertised.contains("/plain") && advertised.contains("/latched")),
            "{first:?}"
        );
        messages(&hub, 2);
        subscribe(&hub, 1, 70, plain);
        subscribe(&hub, 1, 71, latched);
        assert!(hub.needs(plain) && hub.has_subscribers());
        assert_eq!(messages(&hub, 1), [QueuedMessage::Binary(message_data(71, 2, b"kept"))]);
        hub.publish(plain, 3, b"new");
        assert_eq!(messages(&hub, 1), [QueuedMessage::Binary(message_data(70, 3, b"new"))]);
        assert_eq!(messages(&hub, 2), []);
        let third = hub.add_channel(described("/third", false));
        for viewer in [1, 2] {
            let said = messages(&hub, viewer);
            assert!(
                matches!(&said[..], [QueuedMessage::Text(text)] if text.contains("/third")),
                "{third}: {said:?}"
            );
        }
        hub.remove_viewer(1);
        assert!(!hub.has_subscribers());
    }

    #[test]
    fn a_recording_tells_its_time_and_keeps_the_last_message_of_each_topic() {
        let hub = MessageHub::new("skinbus".to_owned(), "1".to_owned(), true);
        let plain = hub.add_channel(described("/plain", false));
        hub.publish(plain, 1, b"before");
        hub.publish_time(5);
        hub.add_viewer(1);
        let time_5 = QueuedMessage::Binary(vec![2, 5, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(messages(&hub, 1).last(), Some(&time_5));
        subscribe(&hub, 1, 70, plain);
        hub.publish_time(5);
        assert_eq!(messages(&hub, 1), [QueuedMessage::Binary(message_data(70, 1, b"before"))]);
        let latched = hub.add_channel(described("/latched", true));
        messages(&hub, 1);
        subscribe(&hub, 1, 71, latched);
        hub.publish(latched, 2, b"kept");
        hub.publish(plain, 6, b"dropped by the jump");
        hub.clear_messages();
        hub.publish_time(4);
        let time_4 = QueuedMessage::Binary(vec![2, 4, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(messages(&hub, 1), [QueuedMessage::Binary(message_data(71, 2, b"kept")), time_4]);
    }

    #[test]
    fn messages_are_encoded_as_in_a_recording() {
        let hub = Arc::new(MessageHub::new(String::new(), String::new(), false));
        let mut sink = HubSink::new(Arc::clone(&hub));
        let mut channel = sink.add_channel::<StringMessage<'_>>("/text", &[]).unwrap();
        hub.add_viewer(1);
        messages(&hub, 1);
        sink.write(&mut channel, 1, &StringMessage("nobody"));
        subscribe(&hub, 1, 0, 0);
        sink.write(&mut channel, 2, &StringMessage("ab"));
        let text = [0, 1, 0, 0, 3, 0, 0, 0, b'a', b'b', 0];
        assert_eq!(messages(&hub, 1), [QueuedMessage::Binary(message_data(0, 2, &text))]);
    }
}
