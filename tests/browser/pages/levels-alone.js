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
    const rig = new THREE.Group().add(camera)
    rig.rotation.y = Math.PI / 2
    rig.scale.setScalar(2)
    const [x, y, z] = middle // a camera that the rig puts 10 units away along x
    camera.position.set(-z / 2, y / 2, (x + 10) / 2)
    found.camera_in_a_rig = levels.zoom(camera, renderer)
    rig.remove(camera)
    camera.position.set(x, y, z + 10)
    found.render_target = levels.zoom(camera, renderer, 50)
    camera.rotation.y = Math.PI
    found.turned_away = levels.zoom(camera, renderer)
    camera.rotation.y = 0
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

  // How often the finest level was asked for, whose file fails once: when it is wanted first, in the next frames, and when the module's timer is over.
  async function again(Levels, manifest) {
    const { setTimeout } = globalThis
    let over = null
    globalThis.setTimeout = (call) => (over = call)
    let asked = 0
    const levels = new Levels(manifest, async () => {
      asked += 1
      if (asked === 1) throw new Error('the first answer of this test')
      return new THREE.Group()
    })
    const first = [await from(levels, 10), asked]
    const next = [await from(levels, 10), asked]
    globalThis.setTimeout = setTimeout
    over()
    return { first, next, later: [await from(levels, 10), asked] }
  }

  // Of a ladder that is disposed of while a level is on its way: which levels were freed, whether it is in the scene, and what it still draws.
  async function disposed(Levels, manifest) {
    const freed = []
    const levels = new Levels(manifest, async (file) => Object.assign(new THREE.Group(), { dispose: () => freed.push(file) }))
    const scene = new THREE.Scene().add(levels)
    await levels.opened(2)
    const coming = levels.opened(0)
    levels.dispose()
    await coming
    return [freed, scene.children.length, levels.children.length]
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
        again: await again(Levels, levels.manifest),
        disposed: await disposed(Levels, levels.manifest),
        no_manifest: await why(Levels.load(open, `${url}/page`)),
        no_folder: await why(Levels.load(open, '/pages/')),
        by_distance: await why(Levels.load(open, `${url}/distance/`)),
      }
    },
  }
}
