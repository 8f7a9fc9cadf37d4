// Shows a ladder of levels in three.js: in each frame the level that fits how large a pixel is at what is seen. It was written by mipmap_plugin
// with levels.json and the level files, which lie beside it. With Spark:
//
//     scene.add(new SparkRenderer({ renderer })) // once a page: without it Spark draws nothing
//     const levels = await Levels.load(async (url) => {
//       const splats = new SplatMesh({ url })
//       await splats.initialized
//       return splats
//     })
//     levels.quaternion.set(1, 0, 0, 0) // most files have y down
//     scene.add(levels)
//     renderer.setAnimationLoop(() => {
//       levels.update(camera, renderer)
//       renderer.render(scene, camera)
//     })

import { Group, Matrix4, Vector2, Vector3, Vector4 } from 'three'

// A level stays until the zoom is so much beyond its switch, so that nothing flickers where a camera rests.
const STAYS = 1.02

// Milliseconds until a level whose file did not load is tried again.
const AGAIN = 5000

export class Levels extends Group {
  // `open`: makes of the URL of a level's file what draws it, an Object3D, or a promise of it. `folder`: where the ladder lies, a URL or the path of
  // one; by default where this module lies.
  static async load(open, folder = new URL('.', import.meta.url)) {
    const whole = new URL(`${folder}`.replace(/\/?$/, '/'), location.href)
    const answer = await fetch(new URL('levels.json', whole))
    if (!answer.ok) throw new Error(`${answer.url}: ${answer.status} ${answer.statusText}`)
    const manifest = await answer.json().catch(() => {
      throw new Error(`${answer.url} is no levels.json: give the folder of the ladder, as the server knows it`)
    })
    if (!manifest.looked_at) throw new Error(`${answer.url} is of a ladder by distance, or of an earlier version: make one by zoom (--by zoom)`)
    const levels = new Levels(manifest, (file) => open(new URL(file, whole).href))
    await levels.opened(levels.wanted)
    return levels
  }

  // `manifest`: levels.json; `open`: makes what draws a level of its file's name.
  constructor(manifest, open) {
    super()
    this.manifest = manifest
    this.open = open
    this.drawn = manifest.levels.map(() => null) // what draws each level, once it is there
    this.opening = manifest.levels.map(() => null)
    this.disposed = false
    this.wanted = manifest.levels.length - 1 // the coarsest, which is the first to be there
    this.shown = this.wanted
  }

  // To be called before each frame. A level is loaded when it is wanted first; until it is there the nearest one is shown. `height`: of the picture in
  // pixels, where that is not the whole canvas: of a viewport or a render target.
  update(camera, renderer, height) {
    const zoom = this.zoom(camera, renderer, height)
    const stays = [this.fitting(zoom * STAYS), this.fitting(zoom / STAYS)].includes(this.wanted)
    if (!stays) this.wanted = this.fitting(zoom)
    if (!this.opening[this.wanted]) this.opened(this.wanted).catch(console.error)
    const there = this.drawn.flatMap((splats, level) => (splats ? [level] : []))
    this.shown = there.reduce((best, each) => (Math.abs(each - this.wanted) < Math.abs(best - this.wanted) ? each : best), there[0])
    this.drawn.forEach((splats, level) => splats && (splats.visible = level === this.shown))
  }

  // How large what is in the picture is on the canvas, over how large it was in training: the median of splats that the views of the training looked
  // at, and the middle of the scene where none of them is in the picture.
  zoom(camera, renderer, height = renderer.getDrawingBufferSize(new Vector2()).y) {
    this.updateWorldMatrix(true, false)
    camera.updateWorldMatrix(true, false)
    const { looked_at, middle, view_pixel } = this.manifest
    const toCamera = new Matrix4().multiplyMatrices(camera.matrixWorldInverse, this.matrixWorld)
    const toCanvas = new Matrix4().multiplyMatrices(camera.projectionMatrix, toCamera)
    const projection = camera.projectionMatrix.elements // by columns: 5 is twice the focal length over the height, 15 is 1 without perspective
    const pixels = (new Vector3().setFromMatrixScale(toCamera).x * projection[5] * height) / 2 // of what is as long as it is far away
    const zooms = looked_at.flatMap(([x, y, z, pixel]) => {
      const { x: right, y: up, w: depth } = new Vector4(x, y, z, 1).applyMatrix4(toCanvas)
      return depth > 0 && Math.abs(right) < depth && Math.abs(up) < depth ? [(pixel * pixels) / depth] : []
    })
    if (zooms.length) return zooms.sort((one, other) => one - other)[zooms.length >> 1]
    return (view_pixel * pixels) / (projection[15] === 1 ? 1 : new Vector3(...middle).applyMatrix4(toCamera).length())
  }

  // The number of the level that is to be shown at a zoom: 0 is the finest.
  fitting(zoom) {
    return this.manifest.switches.filter((each) => zoom < each.zoom).length
  }

  // Resolves once a level is there. One that failed is tried again when it is wanted after a while.
  opened(level) {
    this.opening[level] ??= this.#open(level).catch((error) => {
      setTimeout(() => (this.opening[level] = null), AGAIN)
      throw error
    })
    return this.opening[level]
  }

  // Takes the ladder out of the page, and frees what draws its levels, where that has a `dispose`.
  dispose() {
    this.disposed = true
    this.removeFromParent()
    this.drawn.forEach((splats) => splats?.dispose?.())
  }

  async #open(level) {
    const splats = await this.open(this.manifest.levels[level].file)
    if (this.disposed) return splats.dispose?.()
    splats.visible = false
    this.drawn[level] = splats
    this.add(splats)
  }
}
