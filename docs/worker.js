// A browser lets no page that is a file start a worker, and the search runs in one: here its script runs in a frame that
// is not shown, and hears and says what it would in a worker.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.srcdoc = "<!doctype html>";
      this.ready = new Promise((ready) => {
        frame.addEventListener("load", () => {
          const inner = frame.contentWindow;
          inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
          inner.importScripts = (...addresses) => Promise.all(addresses.map((other) => load(inner, other)));
          load(inner, address).then(() => ready(inner));
        });
      });
      document.body.append(frame);
    }

    postMessage(data) {
      this.ready.then((inner) => inner.dispatchEvent(new MessageEvent("message", { data })));
    }
  };

  const load = (inner, address) =>
    new Promise((loaded) => {
      const script = inner.document.createElement("script");
      script.src = address;
      script.addEventListener("load", loaded);
      inner.document.body.append(script);
    });
}
