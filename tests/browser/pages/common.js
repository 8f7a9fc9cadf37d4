// What every page of a viewer needs. A view is {width, height, projection, viewmat, background}: matrices are OpenGL's, 16 numbers by columns.

// Frames that a page may take until its picture is settled: half a minute of slow ones.
const MOST_FRAMES = 300

export const canvas = document.querySelector('canvas')

export const nextFrame = () => new Promise((resolve) => requestAnimationFrame(resolve))

// Draws frame after frame until one has begun that was `settled()` before.
export async function drawUntil(settled, frame) {
  for (let i = 0; i < MOST_FRAMES; i++) {
    const isLast = settled()
    await frame()
    if (isLast) return
    await nextFrame()
  }
  throw new Error(`the viewer was still sorting after ${MOST_FRAMES} frames`)
}

// The canvas' pixels as base64 of RGBA bytes, the bottom row first; to be asked for in the task that drew them.
// `behind`: the color of the page behind a canvas that is transparent, 0..1.
export function readPixels(gl, { width, height }, behind = null) {
  const bytes = new Uint8ClampedArray(width * height * 4)
  gl.bindFramebuffer(gl.FRAMEBUFFER, null)
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(bytes.buffer))
  if (behind) for (let i = 0; i < bytes.length; i++) if (i % 4 < 3) bytes[i] += (255 - bytes[i - (i % 4) + 3]) * behind[i % 4]
  return base64(bytes)
}

// Makes WebGPU contexts hand out a texture of ours: Chromium's software device draws, but has no canvas to draw on.
export function drawToTexture() {
  const target = { device: null, texture: null }
  let format = ''
  GPUCanvasContext.prototype.configure = (settings) => {
    Object.assign(target, { device: settings.device, texture: null })
    format = settings.format
  }
  GPUCanvasContext.prototype.getCurrentTexture = function () {
    const size = [this.canvas.width, this.canvas.height]
    if (target.texture?.width !== size[0] || target.texture?.height !== size[1]) {
      const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC | GPUTextureUsage.TEXTURE_BINDING
      target.texture = target.device.createTexture({ size, format, usage })
    }
    return target.texture
  }
  return target
}

// That texture's pixels, as `readPixels` gives them.
export async function readTexture({ device, texture }) {
  const { width, height, format } = texture
  const stride = Math.ceil((width * 4) / 256) * 256 // WebGPU's rule for rows in a buffer
  const buffer = device.createBuffer({ size: stride * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ })
  const encoder = device.createCommandEncoder()
  encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow: stride }, [width, height])
  device.queue.submit([encoder.finish()])
  await buffer.mapAsync(GPUMapMode.READ)
  const rows = new Uint8Array(buffer.getMappedRange())
  const bytes = new Uint8Array(width * height * 4)
  for (let y = 0; y < height; y++) bytes.set(rows.subarray(y * stride, y * stride + width * 4), (height - 1 - y) * width * 4)
  buffer.destroy()
  if (format.startsWith('bgra')) for (let i = 0; i < bytes.length; i += 4) [bytes[i], bytes[i + 2]] = [bytes[i + 2], bytes[i]]
  return base64(bytes)
}

function base64(bytes) {
  let text = ''
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768))
  return btoa(text)
}

// A three.js camera with exactly this view, which nothing recomputes.
export function pose(camera, view) {
  camera.matrixAutoUpdate = false
  camera.matrixWorldAutoUpdate = false
  camera.projectionMatrix.fromArray(view.projection)
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert()
  camera.matrixWorldInverse.fromArray(view.viewmat)
  camera.matrixWorld.copy(camera.matrixWorldInverse).invert()
  camera.matrix.copy(camera.matrixWorld)
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale)
  camera.fov = (2 * Math.atan(1 / view.projection[5]) * 180) / Math.PI
  camera.aspect = view.width / view.height
}
