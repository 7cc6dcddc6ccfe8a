//! Accepts clients, and disconnects those for which there is no free file descriptor.

use std::io;
use std::os::fd::OwnedFd;
use std::time::Duration;

use protocol::bus::batch::{is_memory_shortage, send_one};
use protocol::bus::embedded::{
    ClientHello, FIGURES_REQUEST, HelloReply, MAX_HELLO_BYTES, enable_time_stamps,
};
use rustix::event::epoll::{self, EventData, EventFlags};
use rustix::io::Errno;
use rustix::net::{RecvFlags, Shutdown, SocketFlags, shutdown, sockopt};

use super::{LISTENER, Server};
use crate::embedded::client::Client;
use crate::embedded::routing::ClientId;

/// The maximum size of the send buffer for a client, in bytes. A client may request less.
const MAX_SEND_BUFFER_BYTES: usize = 64 << 20;

/// The maximum number of clients accepted before frames are forwarded again.
const MAX_ADMISSIONS: usize = 64;

impl Server {
    /// Accepts waiting clients, at most [`MAX_ADMISSIONS`].
    pub(super) fn accept_clients(&mut self) {
        for _ in 0..MAX_ADMISSIONS {
            match self.accept_socket() {
                Ok(socket) => self.admit_client(socket),
                Err(Errno::INTR | Errno::CONNABORTED) => {}
                Err(Errno::AGAIN) => return,
                // The system reports the lack of a file descriptor even if no client waits.
                Err(Errno::MFILE | Errno::NFILE) => match self.reject_client() {
                    Ok(()) => {}
                    Err(Errno::AGAIN) => return,
                    Err(_) => return self.pause(LISTENER),
                },
                Err(_) => return self.pause(LISTENER),
            }
        }
    }

    fn accept_socket(&self) -> Result<OwnedFd, Errno> {
        rustix::net::accept_with(&self.place.listener, SocketFlags::CLOEXEC | SocketFlags::NONBLOCK)
    }

    /// Accepts a client with the reserved file descriptor and disconnects it, because no other descriptor is free. If
    /// the client's hello has not arrived yet, the descriptor is in use until [`Server::close_parting_client`] is
    /// called.
    fn reject_client(&mut self) -> Result<(), Errno> {
        drop(self.spare.take());
        let accepted = self.accept_socket();
        if let Ok(socket) = accepted {
            self.post.totals.turned_away += 1;
            let has_sent = close_connection(&socket);
            self.parting = (!has_sent).then_some(socket);
        } else {
            self.close_parting_client();
            accepted?;
        }
        if self.parting.is_some() {
            return Err(Errno::MFILE);
        }
        self.close_parting_client();
        Ok(())
    }

    /// Disconnects the client that uses the reserved file descriptor, and reserves the descriptor again.
    pub(super) fn close_parting_client(&mut self) {
        if let Some(socket) = self.parting.take() {
            close_connection(&socket);
        }
        self.spare = self.post.epoll.try_clone().ok();
    }

    fn admit_client(&mut self, socket: OwnedFd) {
        let index = self.clients.iter().position(Option::is_none).unwrap_or(self.clients.len());
        let data = EventData::new_u64(index as u64);
        if epoll::add(&self.post.epoll, &socket, data, EventFlags::IN).is_err() {
            self.post.totals.turned_away += 1;
            close_connection(&socket);
            return;
        }
        // Without the time stamps of the kernel, a request has the time at which it is read.
        if self.timed.is_some() {
            let _ = enable_time_stamps(&socket);
        }
        let mut client = Client::new(ClientId(index), socket);
        let is_alone = |other: &&mut Client| other.process == client.process && other.sibling.is_none();
        if client.process.is_some()
            && let Some(other) = self.clients.iter_mut().flatten().find(is_alone)
        {
            (other.sibling, client.sibling) = (Some(client.id), Some(other.id));
        }
        match self.clients.get_mut(index) {
            Some(slot) => *slot = Some(client),
            None => self.clients.push(Some(client)),
        }
    }

    /// Reads the first datagram of a client, its hello, and sets the filters in it.
    pub(super) fn receive_hello(&mut self, id: ClientId) {
        let is_timed = self.timed.is_some();
        let Some(client) = self.client(id) else { return };
        let mut bytes = [0; MAX_HELLO_BYTES + 1];
        let (hello, refused) = match rustix::net::recv(&client.socket, &mut bytes, RecvFlags::DONTWAIT) {
            Err(Errno::AGAIN | Errno::INTR) => return,
            Err(errno @ (Errno::NOMEM | Errno::NOBUFS)) => return self.handle_failure(id, errno),
            Ok((0, _)) | Err(_) => return self.remove_client(id),
            Ok((len, _)) if bytes.get(..len) == Some(&FIGURES_REQUEST) => {
                self.answer_figures_request(id);
                return self.remove_client(id);
            }
            Ok((len, _)) => {
                let bytes = bytes.get(..len).unwrap_or_default();
                (ClientHello::decode(bytes), ClientHello::refused_version(bytes))
            }
        };
        let Some(hello) = hello else {
            // The client may have closed its socket already, so an error is ignored.
            let _ = send_one(&client.socket, &HelloReply::Refused { version: refused }.encode());
            self.post.totals.refused += 1;
            return self.remove_client(id);
        };
        let target =
            usize::try_from(hello.buffer).unwrap_or(MAX_SEND_BUFFER_BYTES).min(MAX_SEND_BUFFER_BYTES);
        if sockopt::set_socket_send_buffer_size_force(&client.socket, target).is_err() {
            // If the size cannot be set, the client is told the size that the socket has.
            let _ = sockopt::set_socket_send_buffer_size(&client.socket, target);
        }
        let granted = sockopt::socket_send_buffer_size(&client.socket).unwrap_or(0) as u64;
        client.greeted = true;
        client.fd = hello.fd;
        client.stamps = hello.stamps && is_timed;
        let welcome = HelloReply::Welcome { granted, version: hello.version, stamps: client.stamps };
        if send_welcome(&client.socket, welcome).is_err() {
            return self.remove_client(id);
        }
        self.post.totals.clients += 1;
        self.router.insert(id, &hello);
    }
}

/// Closes a connection without an answer. Returns true if the client had sent something. That data is read first,
/// because closing with unread data would cause a reset, which the client takes for the end of the server.
fn close_connection(socket: &OwnedFd) -> bool {
    let _ = shutdown(socket, Shutdown::Write);
    rustix::net::recv(socket, &mut [0; MAX_HELLO_BYTES + 1], RecvFlags::DONTWAIT).err() != Some(Errno::AGAIN)
}

/// Sends the answer to a client's hello. As the first datagram in the socket it always finds room, so only a lack of
/// memory can prevent it.
fn send_welcome(socket: &OwnedFd, welcome: HelloReply) -> io::Result<usize> {
    let answer = welcome.encode();
    let mut tries = 0..10;
    loop {
        match send_one(socket, &answer) {
            Err(error) if is_memory_shortage(&error) && tries.next().is_some() => {
                std::thread::sleep(Duration::from_millis(1));
            }
            done => return done,
        }
    }
}
