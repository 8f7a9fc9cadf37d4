import * as THREE from 'three'
import { canvas } from './common.js'

// A ladder in a bare page of three.js, whose levels are nothing but their files' names: what the module does in the cases that pages bring.
export async function start() {
  const renderer = new THREE.WebGLRenderer({ canvas })
  const camera = new THREE.PerspectiveCamera(60, 1, 0.01, 1000)

  const open = async (url) => {
    const answer = await fetch(url)
    if (!answer.ok) throw new Error(`${answer.status}`)
    return new THREE.Group()
  }

  // The zoom of what is seen through a camera that is so far away from a place.
  const zoomAt = (levels, eye, [x, y, z], distance) => {
    eye.position.set(x, y, z + distance)
    return levels.zoom(eye, renderer)
  }

  async function zooms(levels) {
    const middle = levels.manifest.middle
    renderer.setPixelRatio(1)
    renderer.setSize(200, 100, false)
    const found = { plain: zoomAt(levels, camera, middle, 10) }
    renderer.setSize(100, 300, false)
    found.resized = zoomAt(levels, camera, middle, 10)
    renderer.setPixelRatio(2)
    found.finer_pixels = zoomAt(levels, camera, middle, 10)
    renderer.setPixelRatio(1)
    renderer.setSize(200, 100, false)
    const height = 10 * Math.tan(Math.PI / 6)
    found.orthographic = zoomAt(levels, new THREE.OrthographicCamera(-1, 1, height, -height), middle, 5)
    const group = new THREE.Group().add(levels)
    group.scale.setScalar(3)
    found.in_a_group = zoomAt(levels, camera, middle.map((each) => 3 * each), 30)
    group.remove(levels)
    return found
  }

  // The levels that are wanted, shown and there, once those that are wanted from a distance of the middle have come, or have failed.
  async function from(levels, distance) {
    zoomAt(levels, camera, levels.manifest.middle, distance)
    levels.update(camera, renderer)
    await levels.opened(levels.wanted).catch(() => null)
    levels.update(camera, renderer)
    return [levels.wanted, levels.shown, levels.drawn.map((splats) => splats && splats.visible)]
  }

  async function why(loading) {
    return loading.then(() => 'it was loaded', (error) => error.message)
  }

  return {
    async told(url) {
      const { Levels } = await import(`${url}/levels.js`)
      const levels = await Levels.load(open, url) // a path without a slash at its end
      const early = new Levels(levels.manifest, (file) => open(`${url}/${file}`))
      const inside = new Levels(levels.manifest, (file) => open(`${url}/${file}`))
      return {
        zooms: await zooms(levels),
        at_first: [levels.wanted, levels.shown, levels.drawn.map((splats) => splats && splats.visible)],
        missing: await from(levels, 30),
        behind_it: await from(levels, 10),
        early: await from(early, 10),
        inside: await from(inside, 0),
        at_once: await from(await Levels.load(() => new THREE.Group(), url), 10),
        no_folder: await why(Levels.load(open, '/pages/')),
        by_distance: await why(Levels.load(open, `${url}/distance/`)),
      }
    },
  }
}
