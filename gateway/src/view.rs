//! Pages in a browser: `skinbus view`, and the option `--view` of runs.

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

use bench::remote::{JsonPipe, Remote};
use bench::run;
use clap::Args;
use protocol::skin::Skin;
use protocol::usage::Failure;
use trace::capture::{CaptureError, CaptureFormat, Reader};
use trace::recording::robot::RecordedRobot;
use view::foxglove::{FoxgloveOptions, foxglove_url};
use view::play::{self, play_recording};
use view::player::PlayError;
use view::serve::{ServeError, ServeOptions, serve};
use view::server::{PageAccess, page_url};
use view::{RowMesh, Token};

use super::arguments::{BusKinds, bus_names, find_bus, parse_address, parse_time_ns};
use super::input::{
    no_frame_failure, note_skin_difference, read_skin, skin_of_recording, stop_after_input, stop_flag,
};
use super::output::print_note;
use super::robot_file::{SkinRobot, urdf_path};
use super::surface::robot_meshes;
use super::visuals::PackageOptions;
use address::AddressFile;

/// Maximum number of triangles of a robot that a page draws; larger meshes are simplified.
const MAX_TRIANGLES: usize = 20_000;

/// Default address of a page.
const DEFAULT_ADDRESS: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// Show a skin in a browser, live or recorded, and press its cells with the mouse
///
/// Receives on the buses of a bench or a robot, and serves one page that draws the arm and its cells: colours show
/// force, proximity or temperature, shapes show states, and each joint's torque appears beside the central computation.
/// A click presses a cell with a stimulus, if it is in test mode. For a recording, the page plays, scrubs, steps by
/// epoch, and jumps to the next touch, loss, silent cell or halt. The page needs no network but this server, which
/// serves only this machine, unless --listen names another address. A page that can press and halt, or that other
/// machines can reach, has a random token in its address, which the server requires. If the skin has robot.urdf, the
/// robot is drawn by its meshes, as far as they are found. Ctrl-C ends it.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus demo --view
  skinbus view gateway/examples/ur5-253.toml --bus-kind embedded
  skinbus view can1 --skin humanoid.toml
  skinbus view run.mcap --foxglove 8765
  skinbus view run.mcap run-*.mcap --at 12.5
  skinbus view run.log --skin skin.toml
  skinbus view skin.toml --listen 0.0.0.0:8100 --token-file token --read-only")]
pub(crate) struct ViewCommand {
    /// Live: a skin file, for all its buses, or names of buses with --skin. Recorded: a candump log or MCAP recording
    /// (all parts of a split one, in any order)
    #[arg(required = true, value_name = "SKIN|BUS|FILE")]
    sources: Vec<PathBuf>,
    /// Skin file of the buses, or of a recording [default: the skin in the recording]
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Show only this moment of a recording: seconds since the start of the run, or since the first frame of a log
    #[arg(long, value_name = "S", value_parser = parse_time_ns)]
    at: Option<u64>,
    /// Address at which the page is served; port 0 stands for any free port
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_address, default_value_t = DEFAULT_ADDRESS)]
    listen: SocketAddr,
    /// Read the page's secret token from this file [default: the variable SKINBUS_TOKEN, else a random
    /// token]
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Write the page's address to this file, for scripts; only you can read the file, and it is deleted when the
    /// command ends; - for standard output
    #[arg(long, value_name = "FILE")]
    address_file: Option<PathBuf>,
    /// Let web pages only watch: they cannot press cells, halt or resume the robot
    #[arg(long)]
    read_only: bool,
    /// If a bus does not exist yet, wait for it instead of failing
    #[arg(long)]
    wait: bool,
    /// Also serve Foxglove and Lichtblick by WebSocket on this port of 127.0.0.1 (0: any free port): the topics that a
    /// recording has, from a live bus as its frames come, or from a file as the page plays it
    #[arg(long, value_name = "PORT")]
    foxglove: Option<u16>,
    /// Serve the run that started this program: accept connections on the listener at standard input, exchange commands
    /// and states over the socket at standard output, and end with the run
    #[arg(long, hide = true)]
    of_run: bool,
    /// End when standard input ends: the program that started this one may be killed
    #[arg(long, hide = true, conflicts_with = "of_run")]
    end_with_input: bool,
    #[command(flatten)]
    packages: PackageOptions,
    #[command(flatten)]
    kinds: BusKinds,
}

/// Options of a run's page.
#[derive(Args, Debug, Default)]
pub(crate) struct PageOptions {
    /// Write the page's address to this file, for scripts; only you can read the file, and it is deleted when the
    /// command ends; - for standard output
    #[arg(long, value_name = "FILE", requires = "view")]
    address_file: Option<PathBuf>,
    /// Read the page's secret token from this file [default: the variable SKINBUS_TOKEN, else a random
    /// token]
    #[arg(long, value_name = "FILE", requires = "view")]
    token_file: Option<PathBuf>,
}

/// The page to be served, and how.
struct PageServer {
    listener: TcpListener,
    access: PageAccess,
    /// Address of the page, if this program prints it; `None` if the run prints it.
    url: Option<String>,
    viewers: Option<ViewerServer>,
}

/// The socket of Foxglove's viewers, and the token that the user has chosen for them.
struct ViewerServer {
    listener: TcpListener,
    token: Option<Token>,
    url: String,
}

impl ViewerServer {
    /// Opens the socket.
    fn bind(port: u16, token: Option<Token>) -> Result<Self, Failure> {
        let failed = |error: io::Error| {
            let hint = bind_hint(&error);
            Failure::usage_error(format!("--foxglove {port}: {error}; {hint}, or 0 for any free port"))
        };
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(failed)?;
        let url = foxglove_url(listener.local_addr().map_err(failed)?, token.as_ref());
        Ok(Self { listener, token, url })
    }

    fn options(self, robot: Option<RecordedRobot>) -> FoxgloveOptions {
        FoxgloveOptions { listener: self.listener, token: self.token, robot }
    }
}

impl ViewCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let is_recording = self.is_recording()?;
        let may_act = !self.read_only && !is_recording;
        let viewers = self.foxglove.map(|port| {
            self.check_served_to_viewers(port, is_recording)?;
            ViewerServer::bind(port, token::chosen_token(self.token_file.as_deref())?)
        });
        let viewers = viewers.transpose()?;
        let (listener, token) = if self.of_run {
            (inherited_listener().map_err(|error| view_failure(&error))?, token::chosen_token(None)?)
        } else {
            let listen = self.listen;
            let token = token::chosen_token(self.token_file.as_deref())?;
            let bound = TcpListener::bind(listen);
            let listener = bound.map_err(|error| bind_error(listen, &error))?;
            (listener, token::required_token(token, may_act, listen)?)
        };
        let address = listener.local_addr().map_err(|error| view_failure(&error))?;
        let url = (!self.of_run).then(|| page_url(address, token.as_ref()));
        let of_file = self.address_file.as_deref().zip(url.as_deref());
        let _file = of_file.map(|(path, url)| AddressFile::write(path, url)).transpose()?;
        let access = PageAccess { may_act, may_play: is_recording, token };
        let served = PageServer { listener, access, url, viewers };
        if self.end_with_input {
            stop_after_input().map_err(|error| view_failure(&error))?;
        }
        if is_recording { self.serve_recording(served) } else { self.serve_live(served) }
    }

    /// Checks that the messages to be served exist: a candump log has none.
    fn check_served_to_viewers(&self, port: u16, is_recording: bool) -> Result<(), Failure> {
        for path in self.sources.iter().filter(|_| is_recording) {
            if Reader::open(path).map_err(Failure::usage_error)?.format() == CaptureFormat::Candump {
                let path = path.display();
                return Err(Failure::usage_error(format!(
                    "--foxglove {port}: {path} is a candump log, and only an MCAP recording has topics: convert \
                     it with `skinbus convert {path} FILE.mcap`, or leave the option out"
                )));
            }
        }
        Ok(())
    }

    /// Serves the page of live buses.
    fn serve_live(self, served: PageServer) -> Result<(), Failure> {
        let (skin, surface) = match self.sources.as_slice() {
            [one, ..] if !one.exists() => self.skin_on_named_buses()?,
            [one] if self.skin.is_none() && self.at.is_none() => self.read_skin_with_meshes(one)?,
            [one] => {
                let why = "is only for a recording or a bus, but this file is a skin: leave the option out";
                return Err(Failure::usage_error(format!("{}: --skin or --at {why}", one.display())));
            }
            _ => {
                let why = "only the parts of one recording can be shown together, but the first file is a \
                           skin: name only the skin";
                return Err(Failure::usage_error(why));
            }
        };
        let kinds = self.kinds.kinds_of_buses(bus_names(&skin))?;
        let stop = stop_flag()?;
        let bench = self.of_run.then(connect_to_run).transpose().map_err(|error| view_failure(&error))?;
        let PageServer { listener, access, url, viewers } = served;
        let viewers_url = viewers.as_ref().map(|viewers| viewers.url.clone());
        let foxglove = viewers.map(|viewers| {
            let urdf = skin.robot.urdf.as_deref();
            let urdf = self.skin_file().zip(urdf).map(|(skin, urdf)| urdf_path(skin, urdf));
            Ok::<_, Failure>(viewers.options(SkinRobot::read(&skin, urdf.as_deref())?.robot))
        });
        let options = ServeOptions {
            skin,
            surface,
            kinds,
            directory: None,
            listener,
            access,
            waits_for_buses: self.wait,
            bench,
            foxglove: foxglove.transpose()?,
        };
        serve(options, &stop, || print_addresses(url, viewers_url)).map_err(Failure::usage_error)?;
        Ok(())
    }

    /// Returns the part of a skin that is on the named buses, with the meshes of its robot.
    fn skin_on_named_buses(&self) -> Result<(Skin, Vec<RowMesh>), Failure> {
        let Some(file) = &self.skin else {
            let name = self.sources.first().map(|it| it.display().to_string()).unwrap_or_default();
            return Err(Failure::usage_error(format!(
                "there is no file {name}: name a skin (to show its buses), a recording, or a bus with --skin"
            )));
        };
        if self.at.is_some() {
            return Err(Failure::usage_error(
                "--at is only for a recording, not for live buses: leave it out",
            ));
        }
        let (skin, surface) = self.read_skin_with_meshes(file)?;
        let of = |source: &PathBuf| find_bus(&skin, &file.display().to_string(), &source.to_string_lossy());
        let mut buses = self.sources.iter().map(of).collect::<Result<Vec<_>, _>>()?;
        buses.sort_unstable();
        buses.dedup();
        Ok((skin.restricted_to_buses(&buses), surface))
    }

    /// Serves the page of a recording.
    fn serve_recording(self, served: PageServer) -> Result<(), Failure> {
        let (skin, surface) = self.recorded_skin()?;
        #[expect(clippy::cast_precision_loss, reason = "to the µs")]
        let at_s = self.at.map(|nanos| nanos as f64 / 1e9);
        let stop = stop_flag()?;
        let warns = |what: &str| print_note(format_args!("{what}"));
        let PageServer { listener, access, url, viewers } = served;
        let viewers_url = viewers.as_ref().map(|viewers| viewers.url.clone());
        let foxglove = viewers.map(|viewers| viewers.options(None));
        let options =
            play::PlayOptions { paths: self.sources, skin, surface, listener, access, at_s, foxglove };
        play_recording(options, &stop, || print_addresses(url, viewers_url), warns).map_err(|error| {
            match error {
                ServeError::Play(
                    PlayError::Damaged(_) | PlayError::Capture(CaptureError::Damaged { .. }),
                ) => Failure::run_error(error),
                ServeError::Bus(_)
                | ServeError::Play(_)
                | ServeError::Thread(_)
                | ServeError::Server(_)
                | ServeError::Viewers(_) => Failure::usage_error(error),
            }
        })?;
        Ok(())
    }

    /// Returns the skin's file of live buses.
    fn skin_file(&self) -> Option<&Path> {
        self.skin.as_deref().or_else(|| self.sources.first().map(PathBuf::as_path))
    }

    /// Reads a skin with the meshes of its robot, as far as they are found.
    fn read_skin_with_meshes(&self, path: &Path) -> Result<(Skin, Vec<RowMesh>), Failure> {
        let skin = read_skin(path)?;
        let surface = robot_meshes(path, &skin, &self.packages, MAX_TRIANGLES);
        Ok((skin, surface))
    }

    /// Returns the skin of a recording. The skin inside a recording has no URDF beside it.
    fn recorded_skin(&self) -> Result<(Skin, Vec<RowMesh>), Failure> {
        match &self.skin {
            Some(path) => {
                let (skin, shells) = self.read_skin_with_meshes(path)?;
                note_skin_difference(&self.sources, path, &skin);
                Ok((skin, shells))
            }
            None => {
                let skin = skin_of_recording(&self.sources)?;
                if skin.robot.urdf.is_some() {
                    print_note(
                        "the recording does not contain the robot's meshes: to show them, add --skin with \
                         the skin file that lies beside the URDF",
                    );
                }
                Ok((skin, Vec::new()))
            }
        }
    }

    /// Returns true for a recording, false for a skin, by the content of the file.
    fn is_recording(&self) -> Result<bool, Failure> {
        let Some(first) = self.sources.first() else { return Ok(false) };
        if !first.exists() {
            return Ok(false);
        }
        if first.metadata().is_ok_and(|about| !about.is_file()) {
            let what = "is not a regular file: name a skin, to show its buses, or a recording";
            return Err(Failure::usage_error(format!("{} {what}", first.display())));
        }
        let mut reader = Reader::open(first).map_err(Failure::usage_error)?;
        if reader.format() == CaptureFormat::Mcap || reader.has_frame().map_err(Failure::usage_error)? {
            return Ok(true);
        }
        // A file named with --skin or --at is meant as a recording, unless it is a readable skin.
        if (self.skin.is_some() || self.at.is_some()) && Skin::read(first).is_err() {
            return Err(no_frame_failure(&reader));
        }
        Ok(false)
    }
}

/// Returns the error for an address at which no page can be served.
fn bind_error(listen: SocketAddr, error: &io::Error) -> Failure {
    let hint = bind_hint(error);
    Failure::usage_error(format!(
        "--listen {listen}: {error}; {hint}, or leave --listen out for a free port of this machine"
    ))
}

/// Returns what to do after an error of opening a socket.
fn bind_hint(error: &io::Error) -> &'static str {
    let is = |kind| error.kind() == kind;
    if is(io::ErrorKind::AddrNotAvailable) {
        "name an address of this machine"
    } else if is(io::ErrorKind::PermissionDenied) {
        "name a port of at least 1024"
    } else {
        "name another port"
    }
}

/// Prints the addresses of the page and of Foxglove's viewers.
fn print_addresses(page: Option<String>, viewers: Option<String>) {
    page.iter().for_each(|url| print_note(format_args!("view: {url}")));
    viewers.iter().for_each(|url| print_note(format_args!("foxglove: {url}")));
}

/// Returns the connection to the run that has started this program: a socket that is this program's standard output.
fn connect_to_run() -> io::Result<JsonPipe> {
    let socket = || io::stdout().as_fd().try_clone_to_owned();
    JsonPipe::new(socket()?, socket()?)
}

/// Returns the listener that is this program's standard input.
fn inherited_listener() -> io::Result<TcpListener> {
    Ok(io::stdin().as_fd().try_clone_to_owned()?.into())
}

fn view_failure(error: &io::Error) -> Failure {
    Failure::run_error(format!("--view: {error}"))
}

/// The page of a run in a process of its own; dropping it ends the process.
#[derive(Debug)]
pub(crate) struct PageProcess {
    process: Child,
    _address_file: Option<AddressFile>,
}

impl PageProcess {
    /// Starts a process that serves the page of a run, whose buses open later. Returns it with the connection for its
    /// commands.
    pub(crate) fn start(
        run: &run::RunOptions,
        listen: Option<SocketAddr>,
        options: &PageOptions,
    ) -> Result<(Self, Remote), Failure> {
        let run::RunOptions { skin_file, skin, kinds, directory, .. } = run;
        let program = std::env::current_exe().map_err(|error| view_failure(&error))?;
        let mut command = Command::new(program);
        command.args(["view", "--wait", "--of-run"]).arg(skin_file);
        for bus in &skin.buses {
            let kind = kinds.kind_of(&bus.name).resolve(&bus.name);
            command.arg("--bus-kind").arg(OsString::from(format!("{}={kind}", bus.name)));
        }
        if let Some(directory) = directory {
            command.env("SKINBUS_DIR", directory);
        }
        let listen = listen.unwrap_or(DEFAULT_ADDRESS);
        let token = token::required_token(token::chosen_token(options.token_file.as_deref())?, true, listen)?;
        // Only this user can read the environment of a process, but everyone can read its command line.
        match &token {
            Some(token) => command.env(token::TOKEN_VARIABLE, token.as_str()),
            None => command.env_remove(token::TOKEN_VARIABLE),
        };
        let listener = TcpListener::bind(listen).map_err(|error| bind_error(listen, &error))?;
        let address = listener.local_addr().map_err(|error| view_failure(&error))?;
        let url = page_url(address, token.as_ref());
        let address_file = options.address_file.as_deref();
        let address_file = address_file.map(|path| AddressFile::write(path, &url)).transpose()?.flatten();
        let (here, there) = UnixStream::pair().map_err(|error| view_failure(&error))?;
        let lines = here
            .try_clone()
            .and_then(|input| JsonPipe::new(input, here))
            .map_err(|error| view_failure(&error))?;
        // Put the page into its own process group, so that Ctrl-C does not reach it: the run ends the page.
        command.process_group(0).stdin(OwnedFd::from(listener)).stdout(OwnedFd::from(there));
        let process = command.spawn().map_err(|error| view_failure(&error))?;
        print_addresses(Some(url), None);
        let remote = Remote { name: "view", lines, ends_run: false };
        Ok((Self { process, _address_file: address_file }, remote))
    }
}

impl Drop for PageProcess {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
