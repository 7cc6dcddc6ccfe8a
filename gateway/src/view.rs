//! `skinbus view`, and the option `--view` of runs.

mod address;
mod token;

use std::ffi::OsString;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};

use bench::remote::Lines;
use bench::run;
use clap::Args;
use protocol::skin::Skin;
use protocol::usage::Failure;
use trace::capture::{CaptureError, Format, Reader};
use view::Shell;
use view::play::{self, play};
use view::player::PlayError;
use view::serve::{Options, ServeError, serve};
use view::server::{Access, url};

use super::arguments::{BusKinds, bus_names, bus_of, nanos};
use super::input::{no_frame, read_skin, remark_another, skin_of, stopped};
use super::output::note;
use super::surface::shells;
use super::visuals::Packages;
use address::AddressFile;

/// The most triangles of a robot that a page draws; more are simplified.
const TRIANGLES: usize = 20_000;

/// Where a page is served unless it is told.
const LISTEN: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Show a skin in a browser, live or recorded, and press its cells with the mouse
///
/// Listens to the buses of a bench or of a robot, and serves one page that draws the arm and its cells: coloured by force,
/// proximity or temperature, their state by their shape, each joint's torque beside the central computation. A click presses
/// a cell with a stimulus, if it is in test mode. Of a recording the same page plays, scrubs, steps by epoch, and goes to
/// the next touch, loss, silent cell or halt. The page needs no network but this server, which only answers this machine,
/// unless --listen names another address. A page that can press and halt, or that others can reach, has a random token in its
/// address, without which the server tells and does nothing. If the skin has robot.urdf, the robot is drawn by its meshes,
/// as far as they are found. It ends with Ctrl-C.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus demo --view
  skinbus view gateway/examples/ur5-253.toml --bus-kind embedded
  skinbus view can1 --skin humanoid.toml
  skinbus view run.mcap run-*.mcap --at 12.5
  skinbus view run.log --skin skin.toml
  skinbus view skin.toml --listen 0.0.0.0:8100 --token-file token --read-only")]
pub(crate) struct View {
    /// A skin's description, whose buses are listened to; or some of its buses, with --skin; or a candump log or MCAP
    /// recording, or all parts of a split one in any order
    #[arg(required = true, value_name = "SKIN|BUS|FILE")]
    sources: Vec<PathBuf>,
    /// The skin of buses that are named, or of a recording; without it a recording's is the one in it
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Stay at this second of the recorded run, or after the first frame of a log, instead of playing it
    #[arg(long, value_name = "S", value_parser = nanos)]
    at: Option<u64>,
    /// The address of the page; port 0 is any that is free
    #[arg(long, value_name = "ADDRESS:PORT", default_value_t = LISTEN)]
    listen: SocketAddr,
    /// Take the token in the page's address from this file; else from the variable SKINBUS_TOKEN, else it is random
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Write the page's address to this file as well, for scripts: only you can read it, and it goes with the page; - is
    /// standard output
    #[arg(long, value_name = "FILE")]
    address_file: Option<PathBuf>,
    /// Let pages look, but not press, halt or resume
    #[arg(long)]
    read_only: bool,
    /// Wait for buses that are not there yet
    #[arg(long)]
    wait: bool,
    /// Belong to the run that has started it: serve who comes to the listener at standard input, exchange commands and states
    /// over the socket at standard output, end with it
    #[arg(long, hide = true)]
    of_run: bool,
    #[command(flatten)]
    packages: Packages,
    #[command(flatten)]
    kinds: BusKinds,
}

/// The options of a run's page.
#[derive(Args, Debug, Default)]
pub(crate) struct PageOptions {
    /// Write the page's address to this file as well, for scripts: only you can read it, and it goes with the page; - is
    /// standard output
    #[arg(long, value_name = "FILE", requires = "view")]
    address_file: Option<PathBuf>,
    /// Take the token in the page's address from this file; else from the variable SKINBUS_TOKEN, else it is random
    #[arg(long, value_name = "FILE", requires = "view")]
    token_file: Option<PathBuf>,
}

/// A page that is about to be served.
struct Served {
    listener: TcpListener,
    access: Access,
    /// Its address, unless the run says that.
    url: Option<String>,
}

impl View {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let is_recording = self.is_recording()?;
        let may_act = !self.read_only && !is_recording;
        let (listener, token) = if self.of_run {
            (listener_of_run().map_err(|error| failed(&error))?, token::chosen(None)?)
        } else {
            let listen = self.listen;
            let token = token::chosen(self.token_file.as_deref())?;
            let bound = TcpListener::bind(listen);
            let listener = bound.map_err(|error| unbound(listen, &error))?;
            (listener, token::needed(token, may_act, listen)?)
        };
        let address = listener.local_addr().map_err(|error| failed(&error))?;
        let url = (!self.of_run).then(|| url(address, token.as_ref()));
        let of_file = self.address_file.as_deref().zip(url.as_deref());
        let _file = of_file.map(|(path, url)| AddressFile::write(path, url)).transpose()?;
        let served = Served { listener, access: Access { may_act, may_play: is_recording, token }, url };
        if is_recording { self.recorded(served) } else { self.live(served) }
    }

    /// The skin of buses.
    fn live(self, served: Served) -> Result<(), Failure> {
        let (skin, surface) = match self.sources.as_slice() {
            [one, ..] if !one.exists() => self.on_buses()?,
            [one] if self.skin.is_none() && self.at.is_none() => self.read(one)?,
            [one] => {
                let why = "is of a recording, and this is a skin, whose buses are listened to";
                return Err(Failure::usage(format!("{}: --skin or --at {why}", one.display())));
            }
            _ => {
                let why = "several files are the parts of one recording, and a skin is shown alone";
                return Err(Failure::usage(why));
            }
        };
        let kinds = self.kinds.of(bus_names(&skin))?;
        let stop = stopped()?;
        let bench = self.of_run.then(run_of_this).transpose().map_err(|error| failed(&error))?;
        let Served { listener, access, url } = served;
        let options =
            Options { skin, surface, kinds, directory: None, listener, access, patient: self.wait, bench };
        serve(options, &stop, || say(url)).map_err(Failure::usage)?;
        Ok(())
    }

    /// The part of a skin on the buses that are named.
    fn on_buses(&self) -> Result<(Skin, Vec<Shell>), Failure> {
        let Some(file) = &self.skin else {
            let name = self.sources.first().map(|it| it.display().to_string()).unwrap_or_default();
            return Err(Failure::usage(format!(
                "there is no file {name}: name a skin, whose buses are listened to, a recording, or a bus and its --skin"
            )));
        };
        if self.at.is_some() {
            return Err(Failure::usage("--at is of a recording, and buses are listened to"));
        }
        let (skin, surface) = self.read(file)?;
        let of = |source: &PathBuf| bus_of(&skin, &file.display().to_string(), &source.to_string_lossy());
        let mut buses = self.sources.iter().map(of).collect::<Result<Vec<_>, _>>()?;
        buses.sort_unstable();
        buses.dedup();
        Ok((skin.on_buses(&buses), surface))
    }

    /// A recording.
    fn recorded(self, served: Served) -> Result<(), Failure> {
        let (skin, surface) = self.recorded_skin()?;
        #[expect(clippy::cast_precision_loss, reason = "to the µs")]
        let at_s = self.at.map(|nanos| nanos as f64 / 1e9);
        let stop = stopped()?;
        let warns = |what: &str| note(format_args!("{what}"));
        let Served { listener, access, url } = served;
        let options = play::Options { paths: self.sources, skin, surface, listener, access, at_s };
        play(options, &stop, || say(url), warns).map_err(|error| match error {
            ServeError::Play(PlayError::Damaged(_) | PlayError::Capture(CaptureError::Damaged { .. })) => {
                Failure::run(error)
            }
            ServeError::Bus(_) | ServeError::Play(_) | ServeError::Thread(_) | ServeError::Server(_) => {
                Failure::usage(error)
            }
        })?;
        Ok(())
    }

    /// The skin in a file, and its robot by its meshes, as far as they are found.
    fn read(&self, path: &Path) -> Result<(Skin, Vec<Shell>), Failure> {
        let skin = read_skin(path)?;
        let surface = shells(path, &skin, &self.packages, TRIANGLES);
        Ok((skin, surface))
    }

    /// The skin of a recording; of the one in it the URDF is not beside it.
    fn recorded_skin(&self) -> Result<(Skin, Vec<Shell>), Failure> {
        match &self.skin {
            Some(path) => {
                let (skin, shells) = self.read(path)?;
                remark_another(&self.sources, path, &skin);
                Ok((skin, shells))
            }
            None => {
                let skin = skin_of(&self.sources)?;
                if skin.robot.urdf.is_some() {
                    note(
                        "the recording does not have the robot's meshes: with the --skin beside its URDF they are shown",
                    );
                }
                Ok((skin, Vec::new()))
            }
        }
    }

    /// Whether it is a recording, by what is in it, and not a skin.
    fn is_recording(&self) -> Result<bool, Failure> {
        let Some(first) = self.sources.first() else { return Ok(false) };
        if !first.exists() {
            return Ok(false);
        }
        if first.metadata().is_ok_and(|about| !about.is_file()) {
            let what = "is no regular file: name a skin, whose buses are listened to, or a recording";
            return Err(Failure::usage(format!("{} {what}", first.display())));
        }
        let mut reader = Reader::open(first).map_err(Failure::usage)?;
        if reader.format() == Format::Mcap || reader.has_frame().map_err(Failure::usage)? {
            return Ok(true);
        }
        // What is to be shown with a skin of its own, or of which a moment is, is no skin.
        if (self.skin.is_some() || self.at.is_some()) && Skin::read(first).is_err() {
            return Err(no_frame(&reader));
        }
        Ok(false)
    }
}

/// The error for an address that no page can have.
fn unbound(listen: SocketAddr, error: &io::Error) -> Failure {
    let is = |kind| error.kind() == kind;
    let hint = if is(io::ErrorKind::AddrNotAvailable) {
        "name an address of this machine"
    } else if is(io::ErrorKind::PermissionDenied) {
        "name a port from 1024 on"
    } else {
        "name another port"
    };
    Failure::usage(format!(
        "--listen {listen}: {error}; {hint}, or leave it out for a free port of this machine"
    ))
}

/// Prints where the page is.
fn say(url: Option<String>) {
    url.iter().for_each(|url| note(format_args!("view: {url}")));
}

/// Returns the run that has started this program, at the other end of the socket that is its standard output.
fn run_of_this() -> io::Result<Lines> {
    let socket = || io::stdout().as_fd().try_clone_to_owned();
    Lines::new(socket()?, socket()?)
}

/// Returns the listener that is this program's standard input.
fn listener_of_run() -> io::Result<TcpListener> {
    Ok(io::stdin().as_fd().try_clone_to_owned()?.into())
}

fn failed(error: &io::Error) -> Failure {
    Failure::run(format!("--view: {error}"))
}

/// The page of a run, in a process of its own; it ends with this value.
#[derive(Debug)]
pub(crate) struct Page {
    process: Child,
    _address_file: Option<AddressFile>,
}

impl Page {
    /// Serves the page of a run, whose buses open later; and where it sends what pages want of the run.
    pub(crate) fn of(
        run: &run::Options,
        listen: Option<SocketAddr>,
        options: &PageOptions,
    ) -> Result<(Self, Lines), Failure> {
        let run::Options { skin_file, skin, kinds, directory, .. } = run;
        let program = std::env::current_exe().map_err(|error| failed(&error))?;
        let mut command = Command::new(program);
        command.args(["view", "--wait", "--of-run"]).arg(skin_file);
        for bus in &skin.buses {
            let kind = kinds.of(&bus.name).resolve(&bus.name);
            command.arg("--bus-kind").arg(OsString::from(format!("{}={kind}", bus.name)));
        }
        if let Some(directory) = directory {
            command.env("SKINBUS_DIR", directory);
        }
        let listen = listen.unwrap_or(LISTEN);
        let token = token::needed(token::chosen(options.token_file.as_deref())?, true, listen)?;
        // In its environment only this user can read it, on its command line everybody.
        match &token {
            Some(token) => command.env(token::VARIABLE, token.as_str()),
            None => command.env_remove(token::VARIABLE),
        };
        let listener = TcpListener::bind(listen).map_err(|error| unbound(listen, &error))?;
        let address = listener.local_addr().map_err(|error| failed(&error))?;
        let url = url(address, token.as_ref());
        let address_file = options.address_file.as_deref();
        let address_file = address_file.map(|path| AddressFile::write(path, &url)).transpose()?.flatten();
        let (here, there) = UnixStream::pair().map_err(|error| failed(&error))?;
        let lines =
            here.try_clone().and_then(|input| Lines::new(input, here)).map_err(|error| failed(&error))?;
        // Its signals are its own: the run ends it, also on Ctrl-C.
        command.process_group(0).stdin(OwnedFd::from(listener)).stdout(OwnedFd::from(there));
        let process = command.spawn().map_err(|error| failed(&error))?;
        say(Some(url));
        Ok((Self { process, _address_file: address_file }, lines))
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
