// Search in the site where it is opened from a folder: browsers start no workers there,
// so the search runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(address) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.append(frame)
      this.inside = frame.contentWindow
      this.inside.postMessage = data => this.#tell(this, data)
      const script = this.inside.document.createElement("script")
      script.src = address
      this.loaded = new Promise(resolve => { script.onload = resolve })
      this.inside.document.body.append(script)
    }

    postMessage(data) {
      this.loaded.then(() => this.#tell(this.inside, data))
    }

    #tell(target, data) {
      target.dispatchEvent(new MessageEvent("message", {data}))
    }
  }
}
