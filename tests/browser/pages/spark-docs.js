import * as THREE from 'three'
import { canvas, nextFrame } from './common.js'

// The page of the docs, `page.js` beside a ladder, where there are a renderer, a scene and a camera, as it supposes.
export async function start() {
  const size = 64
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false })
  renderer.setPixelRatio(1)
  renderer.setSize(size, size, false)
  const scene = new THREE.Scene()
  const camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000)
  Object.assign(window, { renderer, scene, camera })

  // Whether there is anything in the middle of the canvas.
  function isDrawn() {
    renderer.render(scene, camera)
    const gl = renderer.getContext()
    const pixel = new Uint8Array(4)
    gl.readPixels(size / 2, size / 2, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel)
    return pixel.slice(0, 3).some((channel) => channel > 0)
  }

  return {
    // Whether it draws the ladder, seen from its front at the coarsest level, within 200 frames.
    async told(url) {
      const { middle, view_pixel, switches } = await (await fetch(`${url}/levels.json`)).json()
      const [x, y, z] = [middle[0], -middle[1], -middle[2]] // by half a turn about x, as the docs turn it
      const focal = (size / 2) * camera.projectionMatrix.elements[5]
      camera.position.set(x, y, z + (view_pixel * focal) / (switches.at(-1).zoom / 2))
      await import(`${url}/page.js`)
      for (let i = 0; i < 200; i++) {
        if (isDrawn()) return true
        await nextFrame()
      }
      return false
    },
  }
}
