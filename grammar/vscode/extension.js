// Starts `gbspec lsp` for .gb files and speaks the language server protocol with it over standard input and output.
"use strict";

const { commands, window, workspace } = require("vscode");
const { LanguageClient, TransportKind } = require("vscode-languageclient/node");

let client;

async function start() {
  const [command, ...args] = workspace.getConfiguration("gbspec").get("command");
  const server = { command, args, transport: TransportKind.stdio };
  const options = {
    documentSelector: [{ language: "gb" }],
    synchronize: { fileEvents: workspace.createFileSystemWatcher("**/*.gb") },
  };
  client = new LanguageClient("gbspec", "gbspec", server, options);
  try {
    await client.start();
  } catch (error) {
    client = undefined;
    window.showErrorMessage(
      `gbspec: \`${[command, ...args].join(" ")}\` does not start (${error.message}). ` +
        "Install it with `pip install 'gbspec[lsp]'`, or set `gbspec.command` to where it is.",
    );
  }
}

async function stop() {
  const running = client;
  client = undefined;
  if (running) {
    await running.stop();
  }
}

async function activate(context) {
  const restart = async () => {
    await stop();
    await start();
  };
  context.subscriptions.push(
    commands.registerCommand("gbspec.restart", restart),
    workspace.onDidChangeConfiguration((change) => (change.affectsConfiguration("gbspec.command") ? restart() : undefined)),
  );
  await start();
}

module.exports = { activate, deactivate: stop };
