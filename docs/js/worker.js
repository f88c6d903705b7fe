/* The search runs in a worker, which browsers refuse to pages of the file system. There it runs in a
   hidden frame instead, with the same messages. Elsewhere the browser's own worker stays. */
if (window.location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      this.frame = frame
      window.addEventListener("message", event => {
        if (event.source !== frame.contentWindow) return
        const told = new MessageEvent("message", { data: event.data })
        this.dispatchEvent(told)
        if (this.onmessage) this.onmessage(told)
      })
      const inner = frame.contentWindow
      inner.importScripts = (...urls) => urls.reduce(
        (before, one) => before.then(() => load(inner, one)), Promise.resolve())
      // The worker's answers go to the page, as from a worker.
      inner.postMessage = inner.eval("data => parent.postMessage(data, '*')")
      this.ready = load(inner, url)
    }
    postMessage(data) {
      this.ready = this.ready.then(() =>
        this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })))
    }
    terminate() {
      this.frame.remove()
    }
  }

  const load = (inner, url) => new Promise((done, failed) => {
    const script = inner.document.createElement("script")
    script.src = new URL(url, window.location).href
    script.onload = done
    script.onerror = failed
    inner.document.body.appendChild(script)
  })
}
