// Search on pages that are opened as files: browsers start no worker there, so a hidden frame runs the worker's script.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      this.inner = frame.contentWindow
      this.inner.postMessage = data => this.deliver(this, data)
      this.inner.importScripts = (...urls) => urls.reduce((before, one) => before.then(() => this.load(one)), Promise.resolve())
      this.ready = this.load(url)
    }
    load(url) {
      return new Promise((resolve, reject) => {
        const script = this.inner.document.createElement("script")
        script.src = new URL(url, location.href).href
        script.onload = resolve
        script.onerror = () => reject(new Error(`not loaded: ${url}`))
        this.inner.document.body.appendChild(script)
      })
    }
    deliver(target, data) {
      const event = new MessageEvent("message", { data })
      target.dispatchEvent(event)
      if (target.onmessage && target === this) target.onmessage(event)
    }
    postMessage(data) {
      this.ready.then(() => this.deliver(this.inner, data))
    }
    terminate() {
      this.inner.frameElement.remove()
    }
  }
}
