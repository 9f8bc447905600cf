// `cairn demo` and `cairn console` as processes, in shared memory of their own.
import { spawn, spawnSync } from "node:child_process";
import { mkdtempSync, rmSync, readdirSync, mkdirSync, openSync, symlinkSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";

const BINARY = process.env.CAIRN_BINARY ?? "target/release/cairn";

export class Robot {
  /** `mark`: apart from others of this test. */
  constructor(mark = "") {
    this.name = `cb${process.pid}${mark}`;
    this.folder = mkdtempSync(join(tmpdir(), "cairn-console-"));
    this.log = join(this.folder, "log");
    this.running = new Set();
    writeFileSync(this.log, "");
    this.env = { ...process.env, CAIRN_PREFIX: "robot", CAIRN_IPC_ROOT: join("/tmp", this.name), CAIRN_IPC_PREFIX: `${this.name}_` };
  }

  start(args, stderr) {
    const child = spawn(BINARY, args, { env: this.env, stdio: ["ignore", "ignore", stderr] });
    this.running.add(child);
    child.on("exit", () => this.running.delete(child));
    return child;
  }

  demo(seconds = 160, ...args) {
    return this.start(["demo", "--seconds", `${seconds}`, ...args, "--log", "info", "--output", join(this.folder, "demo")], openSync(this.log, "a"));
  }

  /** A line as a person types it, in the robot's folder: whether it went well, and what it said. Which daemon is meant the line itself must say. */
  type(line) {
    const path = join(this.folder, "path");
    if (!this.hasPath) {
      mkdirSync(path);
      symlinkSync(resolve(BINARY), join(path, "cairn"));
      this.hasPath = true;
    }
    const env = { ...this.env, PATH: `${path}:${process.env.PATH}` };
    delete env.CAIRN_PREFIX;
    const { status, stdout, stderr } = spawnSync("sh", ["-c", line], { env, cwd: this.folder, encoding: "utf8", timeout: 60_000 });
    return { ok: status === 0, said: stdout.trim(), error: stderr.trim() };
  }

  /** Its address, once it listens. */
  console(...args) {
    const child = this.start(["console", "--listen", "127.0.0.1:0", "--log-file", this.log, ...args], "pipe");
    return new Promise((resolve, reject) => {
      let said = "";
      child.stderr.on("data", (data) => {
        said += data;
        const found = said.match(/http:\/\/[\d.]+:\d+\//);
        if (found) resolve({ child, url: found[0] });
      });
      child.on("error", reject);
      child.on("exit", () => reject(new Error(`the console has ended: ${said}`)));
    });
  }

  end() {
    for (const child of this.running) child.kill("SIGKILL");
    rmSync(this.folder, { recursive: true, force: true });
    rmSync(this.env.CAIRN_IPC_ROOT, { recursive: true, force: true });
    for (const file of readdirSync("/dev/shm")) if (file.startsWith(this.env.CAIRN_IPC_PREFIX)) rmSync(join("/dev/shm", file), { force: true });
  }
}
